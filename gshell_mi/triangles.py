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


def vertex_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) a third of the areas of the faces around each vertex."""
    return np.bincount(faces.ravel(), np.repeat(face_areas(vertices, faces) / 3, 3), len(vertices))


def unit(vectors: np.ndarray) -> np.ndarray:
    """(..., 3) vectors at length 1; zero vectors stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def positive_part(
    vertices: np.ndarray, faces: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The part of a mesh in which (V,) values, linear on every face, are positive: (n, 3) vertices and (m, 3)
    faces. The old vertices come first, in use or not.

    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> points, part = positive_part(corners, np.array([[0, 1, 2]]), np.array([1.0, -1.0, -3.0]))
    >>> points[3:].tolist(), part.tolist()
    ([[0.5, 0.0, 0.0], [0.0, 0.25, 0.0]], [[0, 3, 4]])
    """
    positive = values > 0
    number = positive[faces].sum(axis=1)
    cut = (number == 1) | (number == 2)
    whole, mixed = faces[number == 3], faces[cut]
    # Turned so that the first corner is alone on its side.
    lone = (positive[mixed] == (number[cut] == 1)[:, None]).argmax(axis=1)
    a, b, c = np.take_along_axis(mixed, (lone[:, None] + np.arange(3)) % 3, axis=1).T
    ends = np.sort(np.stack([np.concatenate([a, a]), np.concatenate([b, c])], axis=1), axis=1)
    edges, index = np.unique(ends, axis=0, return_inverse=True)
    ab, ac = len(vertices) + index.reshape(2, -1)
    low, high = values[edges].T
    share = (low / (low - high))[:, None]
    points = (1 - share) * vertices[edges[:, 0]] + share * vertices[edges[:, 1]]
    stays = positive[a]
    parts = [
        whole,
        np.stack([a, ab, ac], axis=1)[stays],
        np.stack([ab, b, c], axis=1)[~stays],
        np.stack([ab, c, ac], axis=1)[~stays],
    ]
    return np.concatenate([vertices, points]), np.concatenate(parts)
