"""Triangle meshes divided at the middles of their edges, so that their vertices hold finer colours."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh


def subdivided(
    vertices: np.ndarray, faces: np.ndarray, attributes: dict[str, np.ndarray], levels: int
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Splits every triangle in four, ``levels`` times.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        attributes: (V,) or (V, n), which new vertices have the mean of.
        levels: how often.

    Returns:
        The vertices, those from before first, the faces and the attributes.

    >>> triangle = np.eye(3), np.array([[0, 1, 2]])
    >>> vertices, faces, attributes = subdivided(*triangle, {"height": np.array([0.0, 2.0, 4.0])}, 1)
    >>> len(vertices), len(faces), sorted(attributes["height"].tolist())
    (6, 4, [0.0, 1.0, 2.0, 2.0, 3.0, 4.0])
    """
    flat = {name for name, values in attributes.items() if values.ndim == 1}
    columns = {name: values[:, None] if name in flat else values for name, values in attributes.items()}
    for _ in range(levels if len(faces) else 0):
        divided: Any = trimesh.remesh.subdivide(vertices, faces, vertex_attributes=columns)
        vertices, faces, columns = divided  # two of them without attributes
    found = {name: values[:, 0] if name in flat else values for name, values in columns.items()}
    return vertices, faces, found
