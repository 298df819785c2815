"""A ghost on a template whose openings are decided: tells how well one radiance explains the images."""

from __future__ import annotations

from ...views import PinholeViews
from ..config import FitConfig
from ..ghost.ghost_template import GhostTemplate
from ..ghost.pixels import PixelPool
from ..ghost.radiance_ghost import RadianceGhost


def fitted_ghost(template: GhostTemplate, views: PinholeViews, pixels: PixelPool, config: FitConfig,
                 **rounds: int) -> RadianceGhost:
    """A glossy ghost, its radiance fitted to ``pixels`` from grey; ``rounds`` as of its ``refit_anew``."""
    ghost = RadianceGhost(template.start, template.faces, views, pixels, config, glossy=True)
    ghost.refit_anew(template.solid, **rounds)
    return ghost
