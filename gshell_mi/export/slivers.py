"""Triangles too narrow for interpolation in single precision."""

from __future__ import annotations

import numpy as np

from ..triangles import area_vectors, unit

#: Height over longest edge that a triangle is given. Renderers get barycentric coordinates from a hit's
#: position with a relative error of about 6e-8 over the square of this: 2 per cent for 2e-3, and no number at
#: all for 2e-4.
_NARROWEST = 2e-3

#: Rounds after which what is still narrow stays: a vertex that makes way may narrow the next triangle.
_ROUNDS = 8


def without_slivers(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, narrowest: float = _NARROWEST
) -> np.ndarray:
    """The vertices, of which those that make triangles narrow have moved as little as mends that.

    Where two cuts of an extraction nearly meet, triangles come out as slivers. Stock Mitsuba interpolates NaN
    over them, and one such sample blackens all pixels around it.

    Args:
        vertices: (V, 3) positions.
        faces: (F, 3).
        normals: (V, 3) of the surface around each vertex; a sliver's own is noise.
        narrowest: the least height of a triangle, in lengths of its longest edge.

    Returns:
        (V, 3) positions, in double precision; no vertex of a triangle that is wide enough moves by itself.

    >>> flat = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, 1e-7, 0]])
    >>> up = np.tile([0.0, 0, 1], (4, 1))
    >>> without_slivers(flat, np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]]), up, 0.01)[3].round(6).tolist()
    [0.5, 0.011, 0.0]
    """
    moved = np.array(vertices, np.float64)
    for _ in range(_ROUNDS):
        corners = moved[faces]
        edges = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)  # edge i lies opposite corner i
        lengths = np.linalg.norm(edges, axis=2)
        corner = lengths.argmax(axis=1)
        length = lengths.max(axis=1)
        narrow = np.linalg.norm(area_vectors(moved, faces), axis=1) < narrowest * length**2
        if not narrow.any():
            break
        chosen = np.flatnonzero(narrow)
        apex, edge = faces[chosen, corner[chosen]], edges[chosen, corner[chosen]]
        inwards = unit(np.cross(normals[apex], edge))
        height = np.einsum("fi,fi->f", inwards, moved[apex] - moved[faces[chosen, (corner[chosen] + 1) % 3]])
        missing = 1.1 * narrowest * length[chosen] - height
        count = np.bincount(apex, minlength=len(moved))[apex]
        np.add.at(moved, apex, inwards * (missing / count)[:, None])
    return moved
