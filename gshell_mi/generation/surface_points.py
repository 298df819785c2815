"""Points on meshes."""

from __future__ import annotations

import numpy as np
import trimesh


def surface_points(mesh: trimesh.Trimesh, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(count, 3) points, uniformly on the surface, and the face (count,) that each is on.

    >>> points, faces = surface_points(trimesh.creation.box(), 5)
    >>> points.shape, bool((np.abs(points).max(axis=1) > 0.499).all())
    ((5, 3), True)
    """
    found = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(found[0]), np.asarray(found[1])
