"""For every edge of a scene the directions from which it is a silhouette.

Seen along its axis, an edge is the tip of a wedge that holds all its faces. Light that travels in a
line outside the wedge has all faces on one side: the edge is a silhouette for it, and casts a shadow.
These directions fill two opposite lunes around the axis, between the planes of the outermost faces.
An edge of one face has lunes of half the sphere, one between coplanar faces none.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..arrays import AnyArray
from .edge_table import SIZE_INDEPENDENT, EdgeTable, join
from .silhouette_edges import crease_mask

#: Narrower lunes (radians) are those of flat faces, whose angle rounding errors make up.
_FLAT = 1e-4


@dataclass
class EdgeWedges:
    """Edges of all meshes; angles are around the axis from the first face, ``low <= 0 <= high``."""

    positions: mi.Float  #: attached: the vertices of all meshes, interleaved
    start: mi.UInt32  #: first vertex
    end: mi.UInt32  #: second vertex
    opposite: mi.UInt32  #: third vertex of the first face
    low: mi.Float  #: lowest angle of a face, above -pi
    high: mi.Float  #: highest angle of a face, below pi
    crease: mi.Bool  #: whether the film warp follows it wherever it is seen
    meshes: int  #: how many meshes have edges
    mesh_mass: mi.Float  #: sum of length times opening over the edges of its mesh

    def opening(self) -> mi.Float:
        """Width in radians of each lune."""
        return dr.pi - (self.high - self.low)

    def frame(self, index: mi.UInt32) -> tuple[mi.Point3f, mi.Point3f, mi.Vector3f, mi.Vector3f, mi.Vector3f]:
        """Of edges by index: end points, unit axis, and the unit vectors at angles 0 and 90 degrees."""
        flat = dr.detach(self.positions)
        p, q, r = (
            dr.gather(mi.Point3f, flat, dr.gather(mi.UInt32, x, index))
            for x in (self.start, self.end, self.opposite)
        )
        return p, q, *_frame(p, q, r)


def _frame(p: mi.Point3f, q: mi.Point3f, r: mi.Point3f) -> tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]:
    axis = dr.normalize(q - p)
    inward = r - p
    inward = dr.normalize(inward - axis * dr.dot(axis, inward))
    return axis, inward, dr.cross(axis, inward)


def silhouette_for(
    direction: mi.Vector3f, inward: mi.Vector3f, across: mi.Vector3f, low: mi.Float, high: mi.Float
) -> mi.Bool:
    """Whether a line of the given direction through an edge has all its faces on one side."""
    x, y = dr.dot(direction, inward), dr.dot(direction, across)
    at_low, at_high = (y * dr.cos(a) - x * dr.sin(a) for a in (low, high))
    return (at_low * at_high > 0) & (dr.pi - (high - low) > _FLAT)


def build_edge_wedges(
    tables: list[tuple[mi.Mesh, EdgeTable]], crease_angle: float = 0.1
) -> EdgeWedges | None:
    """The wedges of all edges of the meshes of ``scene_edge_tables``, or ``None`` without edges."""
    parts, buffers, offset = [], [], 0
    for mesh, table in tables:
        part = _mesh_wedges(mesh, table, crease_angle, dr.opaque(mi.UInt32, offset))
        with dr.resume_grad():
            buffers.append(mi.Float(mesh.vertex_positions_buffer()))
        offset += dr.width(buffers[-1]) // 3
        if part is not None:
            parts.append(part)
    if not parts:
        return None
    with dr.resume_grad():
        positions = join(buffers)
    columns = [join([part[k] for part in parts]) for k in range(len(parts[0]))]
    return EdgeWedges(positions, *columns[:-1], meshes=len(parts), mesh_mass=columns[-1])


def _mesh_wedges(
    mesh: mi.Mesh, table: EdgeTable, crease_angle: float, offset: mi.UInt32
) -> list[AnyArray] | None:
    positions, faces = dr.detach(mesh.vertex_positions_buffer()), mesh.faces_buffer()
    n = dr.width(faces)
    corner = dr.arange(mi.UInt32, n)
    face = corner // 3
    side = corner - 3 * face
    opposite = dr.gather(mi.UInt32, faces, 3 * face + dr.select(side == 0, 2, side - 1))
    dr.eval(opposite)

    own = dr.gather(mi.Point3f, positions, opposite)
    p, q, r = (
        dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, x, table.edge, table.valid))
        for x in (table.start, table.end, opposite)
    )
    axis, inward, across = _frame(p, q, r)
    towards = own - p
    towards -= axis * dr.dot(axis, towards)
    angle = dr.atan2(dr.dot(towards, across), dr.dot(towards, inward))
    angle = dr.select(dr.isfinite(angle) & (table.edge != corner), angle, 0)
    low, high = dr.zeros(mi.Float, n), dr.zeros(mi.Float, n)
    dr.scatter_reduce(dr.ReduceOp.Min, low, angle, table.edge, table.valid, mode=SIZE_INDEPENDENT)
    dr.scatter_reduce(dr.ReduceOp.Max, high, angle, table.edge, table.valid, mode=SIZE_INDEPENDENT)

    crease = crease_mask(mesh, table, crease_angle)
    dr.eval(low, high, crease)
    keep = dr.compress((table.degree > 0) & (dr.pi - (high - low) > _FLAT))
    if dr.width(keep) == 0:
        return None
    start, end, opposite, low, high, crease = (
        dr.gather(type(x), x, keep) for x in (table.start, table.end, opposite, low, high, crease)
    )
    p, q = dr.gather(mi.Point3f, positions, start), dr.gather(mi.Point3f, positions, end)
    mass = dr.sum(dr.norm(q - p) * (dr.pi - (high - low)))
    dr.make_opaque(mass)
    result = [
        start + offset,
        end + offset,
        opposite + offset,
        low,
        high,
        crease,
        mass + dr.zeros(mi.Float, dr.width(keep)),
    ]
    dr.eval(result)
    return result
