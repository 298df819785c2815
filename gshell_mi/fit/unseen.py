"""What no view sees from either side is not known, so it is left open."""

from __future__ import annotations

from ..template.unseen import without_unseen
from .stage import Fit
from .surface import Surface


def without_unseen_parts(fit: Fit, surface: Surface) -> Surface:
    """The surface without what no view sees from either side, if there is much of that.

    As openings close, what could be seen through them is seen no more.
    """
    if fit.config.watertight or fit.config.topology.unseen_area >= 1:
        return surface
    msdf = without_unseen(fit.scene.subject, surface.fields, fit.views, fit.config.topology.unseen_area)
    return surface if msdf is None else surface.with_fields(msdf=msdf.numpy())
