"""The radiance that the images show on a mesh."""

from __future__ import annotations

from ..pixels import PixelPool
from ..radiance.shown import Mesh, Shown
from ..radiance.surface_radiance import SurfaceRadiance
from .stage import Fit
from .template import Template


def radiance_on(fit: Fit, mesh: Mesh, like: Shown, pixels: PixelPool | None = None) -> SurfaceRadiance:
    """The radiance of a mesh, all grey so far.

    Args:
        fit: the views.
        mesh: vertices (V, 3) and faces (F, 3), world units.
        like: it mirrors what this mesh does.
        pixels: that it is fitted to; default: those of all views.
    """
    return SurfaceRadiance(
        *mesh,
        fit.views,
        pixels or fit.pixels,
        fit.config.radiance,
        seed=fit.config.seed,
        mirrored=like.mirrored,
    )


def training_radiance(fit: Fit, template: Template) -> SurfaceRadiance:
    """The same of a template whose openings are decided, where it begins, of the training views."""
    like = fit.validation_judge.shown(template.surface)
    return radiance_on(fit, template.closed, like, fit.training)


def fitted_radiance(fit: Fit, template: Template) -> SurfaceRadiance:
    """The same, fitted to these views."""
    appearance = training_radiance(fit, template)
    appearance.refit_anew(template.solid)
    return appearance
