"""Values at the vertices of a mesh, brought from another mesh beside it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..triangles import area_vectors
from .sides import cast, normals_at_vertices

#: Nearest vertices among which one that faces the same way is looked for.
_NEIGHBOURS = 8


def values_nearby(
    vertices: np.ndarray,
    faces: np.ndarray,
    values: np.ndarray,
    points: np.ndarray,
    point_faces: np.ndarray,
    reach: float,
) -> np.ndarray:
    """(n, k) values at the vertices ``points`` of a mesh near another one, from (V, k) at that one's.

    The nearest hit along the normal counts that faces the same way, which is no hit on the other side of a
    thin part; points that have none take the value of the nearest vertex that does, or else of the nearest.
    """
    normals, facing = normals_at_vertices(points, point_faces), normals_at_vertices(vertices, faces)
    near = cKDTree(vertices).query(points, k=_NEIGHBOURS)[1]
    same = np.einsum("nkj,nj->nk", facing[near], normals) > 0
    result = values[near[np.arange(len(points)), same.argmax(axis=1)]]
    best = np.full(len(points), np.inf)
    face_normals = area_vectors(vertices, faces)
    # A ray that starts on the mesh would miss it.
    behind = 0.05 * reach
    for direction in (normals, -normals):
        face, weights, distance = cast(vertices, faces, points - behind * direction, direction, reach)
        distance = np.abs(distance - behind)
        closer = (distance < best) & (np.einsum("nj,nj->n", face_normals[face], normals) > 0)
        best[closer] = distance[closer]
        result[closer] = np.einsum("ni,nik->nk", weights[closer], values[faces[face[closer]]])
    return result
