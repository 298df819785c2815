"""The radiance of a template whose openings are decided: tells how well one radiance explains the images."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ... import losses
from ...pixels import PixelPool, PixelSample
from ..radiance.surface_radiance import RadianceConfig, SurfaceRadiance
from ..stage import Fit
from ..template import Template


def fitted_radiance(template: Template, fit: Fit, config: RadianceConfig | None = None,
                    **rounds: int) -> SurfaceRadiance:
    """A glossy radiance, fitted to the training views from grey.

    Args:
        template: what it is on.
        fit: the views.
        config: in place of the fit's.
        rounds: as of ``SurfaceRadiance.refit_anew``.
    """
    appearance = SurfaceRadiance(template.start, template.faces, fit.views, fit.training,
                                 config or fit.config.radiance, seed=fit.config.seed, glossy=True)
    appearance.refit_anew(template.solid, **rounds)
    return appearance


def ray_errors(appearance: SurfaceRadiance, ray: mi.Ray3f, sample: PixelSample,
               pixels: PixelPool) -> mi.Float:
    """How far what a template shows along rays is from their pixels, coverage included.

    Args:
        sample: the rays' pixels, of ``pixels``.
    """
    radiance, alpha = appearance.see(ray)
    error = dr.abs(losses.tonemap(radiance) - losses.tonemap(sample.radiance))
    coverage = dr.opaque(mi.Float, 3 * pixels.mask_weight(1.0))
    return error.x + error.y + error.z + coverage * dr.abs(alpha - sample.alpha)
