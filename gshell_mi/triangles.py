"""Directions and areas of the triangles of host meshes."""

from __future__ import annotations

import numpy as np


def area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) normals of the faces, (F, 3) indices of (V, 3) vertices, as long as twice their areas.

    >>> area_vectors(np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0]]), np.array([[0, 1, 2]])).tolist()
    [[0, 0, 6]]
    """
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) areas of the faces."""
    return 0.5 * np.linalg.norm(area_vectors(vertices, faces), axis=1)


def unit(vectors: np.ndarray) -> np.ndarray:
    """(..., 3) vectors at length 1; zero vectors stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
