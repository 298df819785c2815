"""The curves inside smooth-shaded faces at which the interpolated normal turns away from the camera.

Reflection ends there although the face is still seen: coarse meshes have a dark rim inside their
silhouette. On each face the curve is a conic, the zero set of ``n(b)·(o - p(b))`` with normal ``n``
and position ``p`` linear in the barycentric coordinates ``b``; it is replaced by its chord, whose
ends, on the edges of the face, are exact.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def shading_rims(mesh: mi.Mesh, viewpoint: mi.Point3f) -> tuple[mi.Point3f, mi.Point3f] | None:
    """End points of the chords in world space, attached to the mesh: two ``Point3f``, or ``None``.

    >>> import numpy as np
    >>> mesh = mi.Mesh('rim', 3, 1, has_vertex_normals=True)
    >>> params = mi.traverse(mesh)
    >>> params['vertex_positions'], params['faces'] = [0, 0, 0,  2, 0, 0,  0, 2, 0], [0, 1, 2]
    >>> _ = params.update()
    >>> params['vertex_normals'] = [0, 0, -1,  0, 0, 1,  0, 0, 1]
    >>> _ = params.update()
    >>> a, b = shading_rims(mesh, mi.Point3f(0, 0, 5))
    >>> np.round(a, 3).ravel().tolist(), np.round(b, 3).ravel().tolist()
    ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    """
    if not mesh.has_vertex_normals() or mesh.has_face_normals():
        return None
    faces = mesh.faces_buffer()
    with dr.suspend_grad():
        corner = [
            dr.gather(mi.UInt32, faces, 3 * dr.arange(mi.UInt32, dr.width(faces) // 3) + k) for k in range(3)
        ]
        side = [dr.dot(n, viewpoint - p) > 0 for p, n in (_vertex(mesh, c) for c in corner)]
        mixed = (side[0] != side[1]) | (side[1] != side[2])
        # The corner whose side differs from that of the other two
        odd = dr.select(side[1] == side[2], 0, dr.select(side[0] == side[2], 1, mi.UInt32(2)))
        index = dr.compress(mixed)
        if dr.width(index) == 0:
            return None
        odd = dr.gather(mi.UInt32, odd, index)
        first, second, third = (dr.gather(mi.UInt32, faces, 3 * index + (odd + k) % 3) for k in range(3))
        dr.eval(first, second, third)
    with dr.resume_grad():
        return _crossing(mesh, first, second, viewpoint), _crossing(mesh, first, third, viewpoint)


def _vertex(mesh: mi.Mesh, index: mi.UInt32) -> tuple[mi.Point3f, mi.Vector3f]:
    return (
        dr.gather(mi.Point3f, mesh.vertex_positions_buffer(), index),
        mi.Vector3f(dr.gather(mi.Normal3f, mesh.vertex_normals_buffer(), index)),
    )


def _crossing(mesh: mi.Mesh, i: mi.UInt32, j: mi.UInt32, viewpoint: mi.Point3f) -> mi.Point3f:
    """Where on the edge from vertex i to j, of different sides, normal and view are at right angles."""
    (p, n), (q, m) = _vertex(mesh, i), _vertex(mesh, j)
    v, w = viewpoint - p, viewpoint - q
    at_p, at_q, mixed = dr.dot(n, v), dr.dot(m, w), dr.dot(n, w) + dr.dot(m, v)
    # (1 - s)^2 at_p + s (1 - s) mixed + s^2 at_q = 0 has one root between 0 and 1.
    a, b = at_p - mixed + at_q, mixed - 2 * at_p
    root = -0.5 * (b + dr.mulsign(dr.sqrt(dr.maximum(dr.square(b) - 4 * a * at_p, 0)), b))
    s, other = at_p / root, root / a
    s = dr.select((s >= 0) & (s <= 1), s, other)
    return mi.Point3f(dr.lerp(p, q, s))
