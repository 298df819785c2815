"""The generalised winding number on a grid, as a harmonic function that jumps across the mesh."""

import numpy as np
import trimesh
from scipy.fft import dstn, idstn

from ..lattice import CubicGrid


def winding_number(grid: CubicGrid, mesh: trimesh.Trimesh) -> np.ndarray:
    """The generalised winding number w at the vertices of a grid, blurred by about a cell.

    It is harmonic but for its jump across the mesh: laplace(w) = -div(n delta)
    (Barill et al. 2018, sec. 2), solved on the grid with w = 0 on its border, as by Kazhdan et al. (2006).
    """
    n, h = grid.stride, grid.spacing
    count = int(np.clip(6 * mesh.area / h**2, 20_000, 1_000_000))
    samples, faces = trimesh.sample.sample_surface(mesh, count, seed=0)[:2]
    area_normals = mesh.face_normals[faces] * mesh.area / count
    cell = (samples - grid.origin) / h
    low = np.clip(np.floor(cell).astype(int), 0, n - 2)
    fraction = cell - low
    density = np.zeros((n**3, 3))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, fraction, 1 - fraction), axis=1)
        index = (low + corner) @ [1, n, n * n]
        for axis in range(3):
            density[:, axis] += np.bincount(index, weight * area_normals[:, axis], n**3)
    density = density.reshape(n, n, n, 3) / h**3  # indexed [z, y, x]
    divergence = np.zeros((n, n, n))
    for axis in range(3):
        divergence += np.gradient(density[..., axis], h, axis=2 - axis)
    if n < 3:
        return np.zeros(n**3)
    inner = slice(1, -1)
    eigenvalue = (2 - 2 * np.cos(np.pi * np.arange(1, n - 1) / (n - 1))) / h**2
    total = eigenvalue[:, None, None] + eigenvalue[:, None] + eigenvalue
    winding = np.zeros((n, n, n))
    winding[inner, inner, inner] = idstn(dstn(divergence[inner, inner, inner], type=1) / total, type=1)
    return winding.ravel()
