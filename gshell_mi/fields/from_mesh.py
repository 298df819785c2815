"""Fields of a triangle mesh, closed or open, to start from."""

from pathlib import Path

import numpy as np
import trimesh
from scipy.fft import dstn, idstn
from scipy.spatial import cKDTree

from ..errors import UserError
from ..lattice import Lattice
from .lattice_fields import LatticeFields

_BAND_CELLS = 3.0  # distances are exact and signs those of the nearest face this near the mesh
# The mSDF is negative farther away than this, so that caps of the template are no surface. An edge that
# crosses the mesh interpolates distances to at most sqrt(3) / 2 cells; one that leaves the band starts
# at 3 - sqrt(3) at least.
_SHEET_CELLS = 1.2
# Past a rim the template goes on in the tangent plane for this long, so that the mSDF cuts it cleanly.
_RIM_CELLS = 2.0


def from_mesh(
    source: str | Path | trimesh.Trimesh, lattice: Lattice, *, to_world: np.ndarray | None = None
) -> LatticeFields:
    """Fields whose surface is the mesh, to the accuracy of the lattice.

    Near the mesh ``sdf`` is the distance to it, signed by the pseudonormal of the nearest point (Baerentzen
    and Aanaes 2005). Farther away, and across openings, it is that of the indicator function whose
    gradient is the mesh's normals (Kazhdan et al. 2006, solved on the lattice), which caps the openings.
    ``msdf`` is the distance to the rims along the mesh, negative where the nearest point of the mesh lies
    on a rim, and negative on the caps. An open mesh must be consistently oriented; layers closer to each
    other than about two cells run into each other.

    Args:
        source: a file that trimesh reads, or a mesh.
        to_world: 4x4 matrix from lattice units to those of the mesh; identity by default.

    Raises:
        UserError: the file cannot be read, holds no faces or does not fit into the lattice.

    >>> from gshell_mi.lattice import TetLattice
    >>> fields = from_mesh(trimesh.creation.icosphere(radius=0.6), TetLattice(16))
    >>> bool((fields.msdf > 0).all()), round(float(fields.sdf[17**3 // 2]), 2)
    (True, -0.6)
    """
    name = "the mesh" if isinstance(source, trimesh.Trimesh) else str(source)
    mesh = _load(source, name)
    if to_world is not None:
        mesh.apply_transform(np.linalg.inv(np.asarray(to_world, float)))
    extent = np.abs(mesh.bounds).max()
    h = lattice.spacing
    if extent > 1 - h:
        raise UserError(
            f"{name}: reaches to {extent:.3g} of the lattice's cube [-1, 1]^3, of which the outer layer of "
            "cells must stay free; enlarge to_world"
        )
    points = lattice.vertex_positions().astype(float)
    count = int(np.clip(6 * mesh.area / h**2, 20_000, 1_000_000))
    samples, sample_faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    tree = cKDTree(samples)
    distance, _ = tree.query(points)

    band = np.flatnonzero(distance < _BAND_CELLS * h)
    closest, height, on_rim = _nearest(mesh, tree, sample_faces, points[band])
    band_distance = np.linalg.norm(points[band] - closest, axis=1)
    distance[band] = band_distance
    sdf = _indicator_distance(lattice, samples, mesh.face_normals[sample_faces] * mesh.area / count)
    sdf = np.clip(sdf, -distance, distance)
    sdf[band] = np.where(on_rim, sdf[band], np.where(height < 0, -band_distance, band_distance))
    beside_rim = on_rim & (band_distance < _RIM_CELLS * h)
    sdf[band[beside_rim]] = height[beside_rim]
    border = np.abs(points).max(axis=1) > 1 - h / 2
    sdf[border] = np.maximum(distance, h / 2)[border]  # the template closes inside the lattice

    rim = _rim_samples(mesh, h / 8)
    if len(rim) == 0:
        return LatticeFields.closed(sdf, lattice.grid)
    msdf = _SHEET_CELLS * h - distance
    rim_distance, _ = cKDTree(rim).query(closest)  # along the surface: 0 where its side ends
    msdf[band] = np.minimum(msdf[band], np.where(on_rim, -band_distance, rim_distance))
    closed = LatticeFields.closed(sdf)
    return LatticeFields(closed.sdf, msdf.astype(np.float32), closed.deform, lattice.grid)


def _load(source: str | Path | trimesh.Trimesh, name: str) -> trimesh.Trimesh:
    if isinstance(source, trimesh.Trimesh):
        mesh = source.copy()
    else:
        try:
            mesh = trimesh.load(source, force="mesh")
        except Exception as error:
            raise UserError(f"{name}: cannot be read as a triangle mesh ({error})") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise UserError(f"{name}: holds no triangles")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    if mesh.is_watertight and mesh.volume < 0:
        mesh.invert()
    return mesh


def _nearest(
    mesh: trimesh.Trimesh, tree: cKDTree, sample_faces: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearest points of the mesh, the heights above their tangent planes, and which lie on a rim."""
    _, index = tree.query(points, k=8)
    candidates = sample_faces[index]
    triangles = mesh.triangles[candidates.ravel()]
    closest = trimesh.triangles.closest_point(triangles, np.repeat(points, 8, axis=0)).reshape(-1, 8, 3)
    best = np.linalg.norm(closest - points[:, None], axis=2).argmin(axis=1)
    rows = np.arange(len(points))
    closest, face = closest[rows, best], candidates[rows, best]

    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], closest)
    vanishing = weights < 1e-4
    corners = mesh.faces[face]
    normal = mesh.face_normals[face].copy()
    rim_vertices, rim_edges = _rim(mesh)
    on_rim = np.zeros(len(points), bool)
    for i in range(3):
        on_edge = vanishing[:, i] & (vanishing.sum(axis=1) == 1)  # the edge opposite to corner i
        edge = np.sort(corners[:, [(i + 1) % 3, (i + 2) % 3]], axis=1)
        normal[on_edge] = _edge_normals(mesh, edge[on_edge])
        on_rim |= on_edge & np.isin(edge @ [len(mesh.vertices), 1], rim_edges @ [len(mesh.vertices), 1])
        at_corner = ~vanishing[:, i] & (vanishing.sum(axis=1) == 2)
        normal[at_corner] = mesh.vertex_normals[corners[at_corner, i]]
        on_rim |= at_corner & np.isin(corners[:, i], rim_vertices)
    height = np.einsum("ij,ij->i", points - closest, normal) / np.linalg.norm(normal, axis=1)
    return closest, height, on_rim


def _edge_normals(mesh: trimesh.Trimesh, edges: np.ndarray) -> np.ndarray:
    """Sum of the normals of the faces at each of the given (sorted) edges."""
    size = len(mesh.vertices)
    keys, inverse = np.unique(mesh.edges_sorted @ [size, 1], return_inverse=True)
    sums = np.zeros((len(keys), 3))
    np.add.at(sums, inverse, mesh.face_normals[mesh.edges_face])
    return sums[np.searchsorted(keys, edges @ [size, 1])]


def _rim(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and (sorted) edges with a face on one side only."""
    edges = mesh.edges_sorted[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    edges = edges.reshape(-1, 2)
    return np.unique(edges), edges


def _rim_samples(mesh: trimesh.Trimesh, spacing: float) -> np.ndarray:
    """Points along the rims, no farther apart than ``spacing``."""
    start, end = (mesh.vertices[_rim(mesh)[1][:, i]] for i in (0, 1))
    steps = np.ceil(np.linalg.norm(end - start, axis=1) / spacing).astype(int) + 1
    edge = np.repeat(np.arange(len(start)), steps)
    t = (np.arange(len(edge)) - np.repeat(np.cumsum(steps) - steps, steps)) / np.repeat(steps, steps)
    return start[edge] + t[:, None] * (end - start)[edge]


def _indicator_distance(lattice: Lattice, samples: np.ndarray, area_normals: np.ndarray) -> np.ndarray:
    """Signed distance to the level 1/2 of the indicator function, to first order.

    Solves laplace(chi) = -div(n delta) with chi = 0 on the border of the lattice.
    """
    n, h = lattice.stride, lattice.spacing
    cell = (samples + 1) / h
    low = np.clip(np.floor(cell).astype(int), 0, n - 2)
    fraction = cell - low
    density = np.zeros((n**3, 3))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, fraction, 1 - fraction), axis=1)
        index = (low + corner) @ [1, n, n * n]
        for axis in range(3):
            density[:, axis] += np.bincount(index, weight * area_normals[:, axis], n**3)
    density = density.reshape(n, n, n, 3) / h**3  # indexed [z, y, x]
    divergence = sum(np.gradient(density[..., axis], h, axis=2 - axis) for axis in range(3))
    if n < 3:
        return np.full(n**3, np.inf)
    inner = slice(1, -1)
    eigenvalue = (2 - 2 * np.cos(np.pi * np.arange(1, n - 1) / (n - 1))) / h**2
    total = eigenvalue[:, None, None] + eigenvalue[:, None] + eigenvalue
    chi = np.zeros((n, n, n))
    chi[inner, inner, inner] = idstn(dstn(divergence[inner, inner, inner], type=1) / total, type=1)
    slope = np.sqrt(sum(g**2 for g in np.gradient(chi, h)))
    return ((0.5 - chi) / np.maximum(slope, 1e-6)).ravel()
