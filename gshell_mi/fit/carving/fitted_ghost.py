"""A ghost on a template whose openings are decided: tells how well one radiance explains the images."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ... import losses
from ...views import PinholeViews
from ..config import FitConfig
from ..ghost.ghost_template import GhostTemplate
from ..ghost.pixels import PixelPool, PixelSample
from ..ghost.radiance_ghost import RadianceGhost


def fitted_ghost(template: GhostTemplate, views: PinholeViews, pixels: PixelPool, config: FitConfig,
                 **rounds: int) -> RadianceGhost:
    """A glossy ghost, its radiance fitted to ``pixels`` from grey; ``rounds`` as of its ``refit_anew``."""
    ghost = RadianceGhost(template.start, template.faces, views, pixels, config, glossy=True)
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
