"""A ghost on a template whose openings are decided: tells how well one radiance explains the images."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ... import losses
from ..ghost.ghost_template import GhostTemplate
from ..ghost.pixels import PixelPool, PixelSample
from ..ghost.radiance_ghost import RadianceConfig, RadianceGhost
from ..stage import Fit


def fitted_ghost(template: GhostTemplate, fit: Fit, config: RadianceConfig | None = None,
                 **rounds: int) -> RadianceGhost:
    """A glossy ghost, its radiance fitted to the training views from grey.

    Args:
        template: what it is on.
        fit: the views.
        config: in place of the fit's.
        rounds: as of ``RadianceGhost.refit_anew``.
    """
    ghost = RadianceGhost(template.start, template.faces, fit.views, fit.training,
                          config or fit.config.radiance, seed=fit.config.seed, glossy=True)
    ghost.refit_anew(template.solid, **rounds)
    return ghost


def ray_errors(ghost: RadianceGhost, ray: mi.Ray3f, sample: PixelSample, pixels: PixelPool) -> mi.Float:
    """How far what a ghost shows along rays is from their pixels, coverage included.

    Args:
        sample: the rays' pixels, of ``pixels``.
    """
    radiance, alpha = ghost.see(ray)
    error = dr.abs(losses.tonemap(radiance) - losses.tonemap(sample.radiance))
    coverage = dr.opaque(mi.Float, 3 * pixels.mask_weight(1.0))
    return error.x + error.y + error.z + coverage * dr.abs(alpha - sample.alpha)
