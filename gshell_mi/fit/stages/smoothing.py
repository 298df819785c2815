"""Smoothing: bumps that explain no unseen view go. Few photographs, or faulty ones, leave such."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ...template.denoise import denoised
from ..bounds import Between
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface

#: Errors that the surface is tried to have, as fractions of the largest: noise is of some size or other.
_FRACTIONS = 0.25, 0.5, 1.0


@dataclass(frozen=True)
class SmoothingConfig:
    """Bumps that are noise."""

    most: Annotated[float, Between(0)] = 0.8
    """How far the surface may be moved to have fewer bumps, in cells; 0 keeps it."""


class Smoothing:
    """Takes bumps from the surface, larger ones as long as that explains unseen views better.

    All views have shaped the surface. One that is right explains the views of one half in the colours that
    the other half gives it; bumps that single views ask for explain neither.
    """

    name = "smoothing"

    def __init__(self, config: SmoothingConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface without bumps that are noise, and with material and light as they were."""
        start, fields, taken, verdicts = surface, surface.fields, 0.0, []
        with steps.task():
            shown = fit.judge.shown(_mesh(fit, surface))
            for tolerance in (self.config.most * fraction for fraction in _FRACTIONS):
                sdf = denoised(fields.sdf, start.lattice, tolerance, fields.deform)
                other = start.with_fields(sdf=sdf)
                then = fit.judge.shown(_mesh(fit, other))
                verdict = fit.judge.compare(shown.whole, then.whole)
                verdicts.append(verdict.facts())
                if not verdict.accepted[0]:
                    break
                surface, shown, taken = other, then, tolerance
        steps.fact("smoothing_verdicts", verdicts)
        steps.fact("smoothed_cells", taken)
        return surface


def _mesh(fit: Fit, surface: Surface):
    return fit.scene.subject.surface_of(surface.fields).to_numpy()[:2]
