"""Smoothing: bumps that explain no unseen view go. Few photographs, or faulty ones, leave such."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import mitsuba as mi

from ...bounds import Between
from ...radiance.shown import Shown
from ...template.denoise import denoised
from ...template.msdf import without_specks
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
        fields, found, cells, verdicts = surface.fields, surface, 0.0, []
        with steps.task():
            before = _shown(fit, surface)
            for error in (self.config.most * fraction for fraction in _FRACTIONS):
                sdf = denoised(fields.sdf, fields.lattice, error, fields.deform, fields.weights)
                other = surface.with_fields(sdf=sdf)
                after = _shown(fit, other)
                verdict = fit.judge.compare(before.whole, after.whole)
                verdicts.append(verdict.facts())
                if not verdict.accepted[0]:
                    break
                found, before, cells = other, after, error
        steps.fact("smoothing_verdicts", verdicts)
        steps.fact("smoothed_cells", cells)
        return surface if found is surface else _without_specks(fit, found)


def _shown(fit: Fit, surface: Surface) -> Shown:
    return fit.judge.shown(fit.mesh(surface))


def _without_specks(fit: Fit, surface: Surface) -> Surface:
    """The surface without cuts and islands that are too small, as the joint stage leaves it."""
    template, fields = fit.scene.subject.surface_of(surface.fields, template=True), surface.fields
    msdf = without_specks(mi.Float(fields.msdf), template, fields.lattice, fit.config.topology.min_area)
    return surface.with_fields(msdf=msdf.numpy())
