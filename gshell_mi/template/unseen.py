"""Opens what no view sees: of the underside of a seat that is photographed from above, nothing is known."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..fields import LatticeFields
from ..topology import equal_patches
from ..triangles import area_vectors, unit, vertex_areas
from ..views import PinholeViews
from ..visibility import best_view
from .msdf import reopened, rewritten, rim_diffusion

#: What is seen at this cosine or less is as good as unseen: a hull ends in surfaces that views only graze.
_GRAZING = 0.2


def without_unseen(
    subject: mi.Shape, fields: LatticeFields, views: PinholeViews, min_area: float
) -> mi.Float | None:
    """The mSDF that also cuts away what no view sees from either side; None if that is little.

    Args:
        subject: the gshell shape, in whose place the surface is.
        fields: of the surface.
        views: the cameras.
        min_area: what is connected and smaller than this fraction of the template's area stays: between
            views, and in folds, there is always something that none of them sees.
    """
    template = subject.surface_of(fields, template=True)
    vertices, faces, _ = subject.surface_of(fields).to_numpy()
    lattice, msdf = fields.lattice, mi.Float(fields.msdf)
    places, cells, _ = template.to_numpy()
    values = template.interpolate(msdf).numpy()
    centers, normals = places[cells].mean(axis=1), unit(area_vectors(places, cells))
    known = np.zeros(len(places), bool)
    known[cells[best_view(centers, normals, (vertices, faces), views) > _GRAZING]] = True
    hidden, area = (values > 0) & ~known, vertex_areas(places, cells)
    patch = equal_patches(hidden, cells)
    unseen = hidden & (np.bincount(patch, area)[patch] > min_area * area.sum())
    if not unseen.any():
        return None
    smooth = rim_diffusion(cells, len(places))
    cut, near = reopened(values, (values <= 0) | unseen, smooth, lattice.spacing)
    return rewritten(msdf, cut, near, template, lattice)
