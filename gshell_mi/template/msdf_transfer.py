"""The openings of a coarse lattice's template on a finer lattice.

A way that is one vertex wide, such as between the ends of a pleat, is gone where a finer lattice has
interpolated the mSDF across it. Along the template it is still there: both lattices have the same one, but
for what interpolation does to it.
"""

from __future__ import annotations

import dataclasses

import mitsuba as mi
import numpy as np

from ..extraction.surface_mesh import SurfaceMesh
from ..fields import LatticeFields
from ..topology import mesh_edges, spread
from .msdf import rewritten
from .values_nearby import values_nearby

#: Farthest way, in cells of the coarse lattice, between both templates.
_REACH = 0.5

#: Around what differs, values are taken from the coarse template up to so many edges away.
_AROUND = 2


def transfer_msdf(subject: mi.Shape, coarse: LatticeFields, fine: LatticeFields) -> LatticeFields:
    """Fine fields that are open where the coarse ones are.

    Args:
        subject: the gshell shape, in whose place both are.
        coarse: any fields.
        fine: the same on a finer lattice, all of it or blocks.
    """
    if (coarse.msdf > 0).all() or not (coarse.sdf < 0).any():
        return fine
    reach = _REACH * coarse.lattice.spacing * subject.length_scale
    vertices, faces, _, values = _template(subject, coarse)
    fine_vertices, fine_faces, template, found = _template(subject, fine)
    wanted = values_nearby(vertices, faces, values[:, None], fine_vertices, fine_faces, reach)[:, 0]
    changed, (edges, _) = (wanted > 0) != (found > 0), mesh_edges(fine_faces)
    for _ in range(_AROUND):
        changed = spread(changed, edges)
    msdf = rewritten(mi.Float(fine.msdf), wanted, changed, template, fine.lattice)
    return dataclasses.replace(fine, msdf=msdf.numpy())


def _template(
    subject: mi.Shape, fields: LatticeFields
) -> tuple[np.ndarray, np.ndarray, SurfaceMesh, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a template, the template, and the mSDF (V,) at its vertices."""
    template = subject.surface_of(fields, template=True)
    vertices, faces, _ = template.to_numpy()
    return vertices, faces, template, template.interpolate(mi.Float(fields.msdf)).numpy()
