"""A signed distance whose surface moves in parts, such as caps and recesses, and is the same elsewhere."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from ..conversion.mesh_distance import nearest_of
from ..topology import equal_patches
from ..triangles import area_vectors, unit
from .sides import cast

#: Cells around a moved part in which a signed distance is that to it; beyond, where the side is another now.
_BAND = 2.0

#: Faces whose centres are nearest to a point, of which one is the nearest.
_CANDIDATES = 8

#: Times that a triangle of a moved part is halved until its sides are a cell.
_HALVINGS = 12

#: Direction of rays that tell inside from outside; along none of a lattice's planes.
_AHEAD = unit(np.array([np.pi, np.e, np.sqrt(2)]))


def with_moved_parts(
    sdf: np.ndarray,
    points: np.ndarray,
    vertices: np.ndarray,
    moved: np.ndarray,
    faces: np.ndarray,
    cell: float,
) -> tuple[np.ndarray, np.ndarray]:
    """A signed distance whose surface passes through parts that have moved. Needs a variant.

    Args:
        sdf: (n,) in cells, at a lattice's vertices.
        points: (n, 3) where these are.
        vertices, moved: (V, 3) of the template, in the unit of the points, and where they come to be.
        faces: (F, 3), oriented outwards.
        cell: side of a lattice cell, in the same unit.

    Returns:
        (n,) values in cells, and which of them are new.
    """
    parts, values, new = (moved != vertices).any(axis=1), np.array(sdf), np.zeros(len(sdf), bool)
    patch = equal_patches(parts, faces)
    # One after the other: two recesses may meet, and a mesh that goes through itself has no inside.
    for number in np.unique(patch[parts]):
        part = parts & (patch == number)
        index, told = _moved(values, points, vertices, moved, faces, part, cell)
        values[index], new[index] = told, True
    return values, new


def _moved(
    sdf: np.ndarray,
    points: np.ndarray,
    vertices: np.ndarray,
    moved: np.ndarray,
    faces: np.ndarray,
    part: np.ndarray,
    cell: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Indices and new values of what a part, (V,) of the vertices, changes on its way."""
    reach, after = _BAND * cell, np.where(part[:, None], moved, vertices)
    swept = np.concatenate([vertices[part], after[part]])
    low, high = swept.min(axis=0) - reach, swept.max(axis=0) + reach
    near = np.flatnonzero(np.all((points > low) & (points < high), axis=1))
    # Values need not have the sign of their side everywhere, so it is by both meshes that it has changed.
    was, now = (_inside(mesh, faces, points[near]) for mesh in (vertices, after))
    covered = part[faces].any(axis=1)
    # Walls of recesses are long triangles, whose centres are far from what is beside them.
    fine, small, *_ = trimesh.remesh.subdivide_to_size(after, faces[covered], cell, max_iter=_HALVINGS)
    there = fine[small]
    centres = np.concatenate([there, vertices[faces[covered]]]).mean(axis=1)
    beside = cKDTree(centres).query(points[near], distance_upper_bound=reach + cell)[0] < np.inf
    asked = (was != now) | beside
    near, was, now = near[asked], was[asked], now[asked]
    triangles = np.concatenate([there, after[faces[~covered]]])
    candidates = cKDTree(triangles.mean(axis=1)).query(points[near], min(_CANDIDATES, len(triangles)))[1]
    face = nearest_of(triangles, points[near], candidates.reshape(len(near), -1))
    foot = trimesh.triangles.closest_point(triangles[face], points[near])
    distance = np.linalg.norm(points[near] - foot, axis=1)
    # What has left leaves values that tell of a surface nearer than any is.
    left = np.abs(sdf[near]) < distance / cell - 1
    told = (was != now) | left | ((face < len(there)) & (distance < reach))
    inside = np.where(was != now, now, sdf[near] < 0)
    return near[told], np.where(inside, -distance, distance)[told] / cell


def _inside(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n,) whether points are in a closed mesh: it is its back that a ray from there meets first."""
    face, _, distance = cast(vertices, faces, points, np.broadcast_to(_AHEAD, points.shape), np.inf)
    return np.isfinite(distance) & (area_vectors(vertices, faces)[face] @ _AHEAD > 0)
