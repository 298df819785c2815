"""The radiance of a template whose openings are decided: tells how well one radiance explains the images."""

from __future__ import annotations

from ..radiance.surface_radiance import SurfaceRadiance
from ..stage import Fit
from ..template import Template


def fitted_radiance(template: Template, fit: Fit) -> SurfaceRadiance:
    """The radiance of a template, fitted to the training views from grey."""
    mirrored = fit.held_out_judge.shown(template.surface).mirrored
    appearance = SurfaceRadiance(
        template.start,
        template.faces,
        fit.views,
        fit.training,
        fit.config.radiance,
        seed=fit.config.seed,
        mirrored=mirrored,
    )
    appearance.refit_anew(template.solid)
    return appearance
