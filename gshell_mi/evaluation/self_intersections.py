"""Where a mesh goes through itself."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..compat import mesh_scene
from ..topology import mesh_edges

#: An edge is followed past so many faces that hold one of its ends, as it may lie in their planes.
_ROUNDS = 4
#: What is nearer to an end of an edge than this fraction of it belongs to the end.
_END = 1e-3


def piercing_edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The edges that go through a face which holds neither of their ends: none if the mesh is embedded.

    Where two triangles cross, two of their edges go through the other one. Needs a Mitsuba variant.

    Args:
        vertices: (V, 3).
        faces: (F, 3).

    Returns:
        (n, 2) vertex numbers.

    >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -1], [0.2, 0.2, 1], [2, 2, 0]], float)
    >>> piercing_edges(corners, np.array([[0, 1, 2], [3, 4, 5]]))
    array([[1, 2],
           [3, 4]])
    """
    if len(faces) == 0:
        return np.zeros((0, 2), int)
    scene = mesh_scene(vertices, faces)
    edges = mesh_edges(faces)[0]
    corners = mi.Point3u(np.ascontiguousarray(faces.T, np.uint32))
    ends = mi.Point2u(np.ascontiguousarray(edges.T, np.uint32))
    start, stop = (mi.Point3f(np.ascontiguousarray(vertices[edges[:, i]].T, np.float32)) for i in (0, 1))
    direction = stop - start
    passed = dr.full(mi.Float, _END, len(edges))
    pierced, going = dr.full(mi.Bool, False, len(edges)), dr.full(mi.Bool, True, len(edges))
    for _ in range(_ROUNDS):
        ray = mi.Ray3f(start + passed * direction, direction)
        ray.maxt = 1 - _END - passed
        hit = scene.ray_intersect_preliminary(ray, active=going & (ray.maxt > 0))
        going &= hit.is_valid()
        face = dr.gather(mi.Point3u, corners, hit.prim_index, going)
        own = mi.Bool(False)
        for end in (ends.x, ends.y):
            own |= (face.x == end) | (face.y == end) | (face.z == end)
        pierced |= going & ~own
        going &= own
        passed += hit.t + _END
        dr.eval(passed, pierced, going)
    return edges[pierced.numpy()]
