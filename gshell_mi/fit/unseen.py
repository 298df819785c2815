"""Opens what no view sees: of the underside of a seat that is photographed from above, nothing is known."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..fields import LatticeFields
from ..fields.smoothing import MeshDiffusion
from ..views import PinholeViews
from ..visibility import best_view
from .opening import clean_opacity, rewritten

#: What is seen at this cosine or less is as good as unseen: a hull ends in surfaces that views only graze.
_GRAZING = 0.2

#: Lambda that smooths the new rims along the template.
_SMOOTHING = 3.0

#: Share of unseen vertices around a vertex from which on its mSDF is new.
_NEAR = 0.01


def without_unseen(subject: mi.Shape, fields: LatticeFields, views: PinholeViews,
                   min_area: float) -> mi.Float | None:
    """The mSDF that also cuts away what no view sees from either side; None if that is little.

    Args:
        subject: the gshell shape; it is left with the fields.
        fields: of the surface.
        views: the cameras.
        min_area: what is connected and smaller than this fraction of the template's area stays: between
            views, and in folds, there is always something that none of them sees.
    """
    subject.set_fields(fields)
    template, (vertices, faces, _) = subject.template(), subject.surface.to_numpy()
    places, cells, _ = template.to_numpy()
    values = template.interpolate(subject.msdf).numpy()
    a, b, c = (places[cells[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    known = np.zeros(len(places), bool)
    known[cells[best_view((a + b + c) / 3, normals, (vertices, faces), views) > _GRAZING]] = True
    # Patches of less than the area flip back.
    unseen = clean_opacity(np.where((values > 0) & ~known, -1.0, 1.0), places, cells, min_area) < 0
    if not unseen.any():
        return None
    smooth = MeshDiffusion(cells, len(places), _SMOOTHING)
    signs = smooth(mi.Float(np.where(unseen | (values <= 0), -1, 1).astype(np.float32))).numpy()
    near = smooth(mi.Float(unseen.astype(np.float32))).numpy() > _NEAR
    cut = np.where(near, signs * subject.lattice.spacing, values)
    return rewritten(dr.detach(subject.msdf), cut, near, template, subject.lattice)
