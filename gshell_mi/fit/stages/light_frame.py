"""Light frame: whether the light is fixed to the world, or turns with the camera.

Where an object turns before a camera on a tripod, or a flash is on the camera, the light comes from the same
side in every view, wherever that is in the object's own frame. In the wrong frame, highlights and shading are
neither gloss nor light, and end as colour and as shape.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...calibration.observations import observe
from ...calibration.regression import ColorModel
from ...light import turns_with_camera
from ..judge import verdict_of
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface
from .exposures import GainsConfig


class LightFrame:
    """Asks in which frame directions explain better what views see of the same places.

    Each region of the surface is foretold by the others, by polynomials of the mirrored direction and of the
    normal, once in the world's frame and once in the camera's. The light turns with the camera if that is
    better by the judge's rule; where nothing is glossy and nothing turns, neither is.
    """

    name = "light"

    def __init__(self, config: GainsConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with what the light is fixed to."""
        with steps.task():
            mesh = fit.mesh(surface)
            seen = observe(
                mesh,
                fit.views,
                fit.scene.targets,
                places=self.config.places,
                cell=fit.cell(surface),
                seed=fit.config.seed,
            )
            turns = turns_with_camera(fit.scene.sensors)
            world, camera = (
                ColorModel(told, self.config.prior * np.log(2)).foretold()
                for told in (seen, seen.turned(turns))
            )
            verdict = verdict_of(world.rays[None], world.errors[None], camera.errors[None])
        steps.fact("light_frame_verdict", verdict.facts())
        return replace(surface, light_turns=np.array(True)) if verdict.accepted[0] else surface
