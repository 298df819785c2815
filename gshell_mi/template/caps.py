"""Caps of openings that go on as smoothly as the surface around them.

Nobody sees a cap, so nothing has shaped it: it is where the hull was, which may bulge from a surface that the
images have moved since. What would close the opening is better told by its surroundings.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.sparse import diags, eye
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from ..conversion.mesh_distance import MeshFeet
from ..fields.smoothing import mesh_laplacian
from ..triangles import area_vectors, unit, vertex_areas

#: What holds a cap without surroundings in place, as a share of what bends it.
_HELD = 1e-6

#: Cells around a cap in which a signed distance is that to it; beyond, where the side is another now.
_BAND = 2.0

#: Faces whose centres are nearest to a point, of which one is the nearest.
_CANDIDATES = 8


def least_bent(vertices: np.ndarray, faces: np.ndarray, free: np.ndarray) -> np.ndarray:
    """(V, 3) vertices of a mesh, the ``free`` (V,) ones where it bends the least: a discrete thin plate
    (Kobbelt and others 1998) that goes on as the rest of the mesh does."""
    chosen, moved = np.flatnonzero(free), np.array(vertices, np.float64)
    if not len(chosen):
        return moved
    laplacian = mesh_laplacian(faces, len(vertices))
    bending = diags(1 / np.maximum(laplacian.diagonal(), 1)) @ laplacian
    energy = (bending.T @ bending).tocsc()[:, chosen]
    system = energy[chosen] + _HELD * eye(len(chosen))
    moved[chosen] -= spsolve(system.tocsc(), energy.T @ moved)
    return moved


def dented(vertices: np.ndarray, faces: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(V, 3) vertices of a mesh, pushed in at some places as deep as these are wide from rim to middle.

    Args:
        vertices, faces: of the mesh, oriented outwards.
        place: (V,) which of the places a vertex is in, from 0; -1 if in none.
    """
    chosen, moved = np.flatnonzero(place >= 0), np.array(vertices, np.float64)
    if not len(chosen):
        return moved
    area = vertex_areas(vertices, faces)
    # On a disc of radius R, the solution of Poisson's equation is (R^2 - r^2) / 4.
    laplacian = mesh_laplacian(faces, len(vertices)).tocsc()[chosen][:, chosen]
    height = np.maximum(spsolve(laplacian + _HELD * eye(len(chosen)), area[chosen]), 0)
    label = place[chosen]
    highest, normals = np.zeros(label.max() + 1), np.zeros((label.max() + 1, 3))
    np.maximum.at(highest, label, height)
    at = place[faces]
    np.add.at(normals, at[at >= 0], np.repeat(area_vectors(vertices, faces), 3, axis=0)[at.ravel() >= 0])
    depth = 2 * height / np.sqrt(np.maximum(highest[label], np.finfo(float).tiny))
    moved[chosen] -= depth[:, None] * unit(normals)[label]
    return moved


def put_in_place(
    sdf: np.ndarray, points: np.ndarray, moved: np.ndarray, faces: np.ndarray, caps: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """A signed distance whose surface passes through caps that have moved, and is the same elsewhere.

    Args:
        sdf: (n,) in cells, at a lattice's vertices.
        points: (n, 3) where these are.
        moved: (V, 3) of the template, in the unit of the points, its caps where they come to be.
        faces: (F, 3), oriented outwards.
        caps: (V,) which vertices have moved.
        cell: side of a lattice cell, in the same unit.

    Returns:
        (n,) values in cells, and which of them are those of caps.
    """
    covered = np.asarray(caps[faces].any(axis=1))
    mesh = trimesh.Trimesh(moved, faces, process=False)
    reach = _BAND * cell
    low, high = np.min(moved[caps], axis=0) - reach, np.max(moved[caps], axis=0) + reach
    near = np.flatnonzero(np.all((points > low) & (points < high), axis=1))
    face = cKDTree(mesh.triangles_center).query(points[near], min(_CANDIDATES, len(faces)))[1]
    feet = MeshFeet(mesh)(points[near], face)
    told = covered[feet.face] & ((feet.distance < reach) | ((sdf[near] < 0) == (feet.height > 0)))
    smooth, chosen = np.array(sdf), np.zeros(len(sdf), bool)
    smooth[near[told]] = np.copysign(feet.distance[told], feet.height[told]) / cell
    chosen[near[told]] = True
    return smooth, chosen
