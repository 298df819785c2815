"""Triangle meshes from files that anybody may have written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from .errors import last_line


def read_triangles(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a mesh file that trimesh reads, as they are stored.

    Raises:
        ValueError: it cannot be read, holds no triangles, or ``check_triangles`` refuses them.
    """
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh's readers raise whatever they stumble over
        raise ValueError(f"cannot be read as a triangle mesh ({last_line(error)})") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError("holds no triangles")
    return check_triangles(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64))


def check_triangles(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same arrays without the vertices that no face uses.

    Raises:
        ValueError: with the rest of a sentence: positions lack a coordinate, a face has a vertex that there
            is not, a position is not finite, or no face has an area.
    """
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError("has vertices with other than three coordinates")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError("has faces of vertices that it lacks")
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    if not np.isfinite(vertices).all():
        raise ValueError("has vertices at NaN or infinity")
    if np.abs(vertices).max(initial=0.0) > 1e15:
        raise ValueError("has vertices too far away to compute with")
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    if not np.cross(b - a, c - a).any():
        raise ValueError("holds no triangles with an area")
    return vertices, faces
