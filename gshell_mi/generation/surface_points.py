"""Points on meshes."""

from __future__ import annotations

import numpy as np
import trimesh

from ..topology import boundary_edges


def surface_points(mesh: trimesh.Trimesh, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(count, 3) points, uniformly on the surface, and the face (count,) that each is on.

    >>> points, faces = surface_points(trimesh.creation.box(), 5)
    >>> points.shape, bool((np.abs(points).max(axis=1) > 0.499).all())
    ((5, 3), True)
    """
    found = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(found[0]), np.asarray(found[1])


def rim_points(mesh: trimesh.Trimesh, count: int, seed: int = 0) -> np.ndarray:
    """(count, 3) points, uniformly along the boundary; (0, 3) of a closed mesh.

    >>> rim_points(trimesh.creation.box(), 5).shape
    (0, 3)
    """
    edges = boundary_edges(np.asarray(mesh.faces))[0]
    if len(edges) == 0:
        return np.zeros((0, 3))
    start, stop = (np.asarray(mesh.vertices)[edges[:, i]] for i in (0, 1))
    length = np.linalg.norm(stop - start, axis=1)
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(edges), count, p=length / length.sum())
    return start[chosen] + rng.uniform(size=(count, 1)) * (stop - start)[chosen]
