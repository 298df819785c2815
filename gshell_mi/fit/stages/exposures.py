"""Exposures: photographs of the same surface differ in exposure and white balance, and views disagree by it.

No later stage knows of that: each is given targets that are corrected. Renders, whose views agree, stay as
they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from ...bounds import Between
from ...calibration.observations import observe
from ..cameras.gains import find_gains
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface


@dataclass(frozen=True)
class GainsConfig:
    """Exposure and white balance of the views, and what the light is fixed to."""

    places: Annotated[int, Between(1)] = 2048
    """Vertices, at most, whose colours in different views are compared."""
    prior: Annotated[float, Between(0.001)] = 1 / 3
    """Standard deviation in stops before anything was seen: cameras are set in steps of a third."""
    least: Annotated[float, Between(0)] = 0.05
    """Standard deviation in stops that gains have to have: what a shape that is not right yet makes up on
    renders of a chair is half of that."""


class Exposures:
    """Finds a gain per view and channel, if that explains what views see of the same places."""

    name = "exposures"

    def __init__(self, config: GainsConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with the gains of the views, or with none if they do not count."""
        config, scene = fit.config, fit.scene
        with steps.task():
            mesh = fit.mesh(surface)
            seen = observe(
                mesh,
                fit.views,
                scene.targets,
                places=self.config.places,
                cell=fit.cell(surface),
                seed=config.seed,
            )
            found = find_gains(seen, self.config.prior * np.log(2))
        stops = float(found.log_gain.std() / np.log(2))
        kept = found.count and stops > self.config.least
        steps.fact(
            "exposures_verdict", found.verdict.facts() | {"look": found.look, "stops": round(stops, 4)}
        )
        steps.fact("exposures_kept", kept)
        return replace(surface, gains=np.exp(found.log_gain).astype(np.float32)) if kept else surface
