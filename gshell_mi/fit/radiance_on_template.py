"""The radiance of a template whose openings are decided."""

from __future__ import annotations

from ..radiance.surface_radiance import SurfaceRadiance
from .stage import Fit
from .template import Template


def radiance_on(template: Template, fit: Fit) -> SurfaceRadiance:
    """The radiance of a template where it begins, of the training views; all is grey so far."""
    mirrored = fit.validation_judge.shown(template.surface).mirrored
    return SurfaceRadiance(
        template.start,
        template.faces,
        fit.views,
        fit.training,
        fit.config.radiance,
        seed=fit.config.seed,
        mirrored=mirrored,
    )


def fitted_radiance(template: Template, fit: Fit) -> SurfaceRadiance:
    """The same, fitted to these views."""
    appearance = radiance_on(template, fit)
    appearance.refit_anew(template.solid)
    return appearance
