"""Where the surface is instead of what closes an opening: caps as smooth as what is around them, recesses.

Nobody sees a cap, so nothing has shaped it: it is where the hull was, which may bulge from a surface that the
images have moved since. What would close the opening is better told by its surroundings. And what seems to be
an opening may be something that lies deeper.
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
from .sides import cast

#: What holds a cap without surroundings in place, as a share of what bends it.
_HELD = 1e-6

#: Cells around a cap in which a signed distance is that to it; beyond, where the side is another now.
_BAND = 2.0

#: Times that a triangle of a moved part is halved until its sides are a cell.
_HALVINGS = 12

#: Direction of rays that tell inside from outside; along none of a lattice's planes.
_AHEAD = unit(np.array([np.pi, np.e, np.sqrt(2)]))

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


class Recesses:
    """Places of a mesh pushed in along their mean normals: flat floors, and walls as steep as a ball's.

    A recess ends half-way to what lies behind it: one that reaches that is an opening.

    Args:
        vertices, faces: of the mesh, oriented outwards.
        place: (V,) which of the places, at least one, a vertex is in, from 0; -1 if in none.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, place: np.ndarray):
        self.vertices, self.faces = np.asarray(vertices, np.float64), faces
        self.chosen = np.flatnonzero(place >= 0)
        self.place = place[self.chosen]
        count = int(place.max()) + 1
        normals, corner = np.zeros((count, 3)), place[faces]
        area = np.repeat(area_vectors(vertices, faces), 3, axis=0)[corner.ravel() >= 0]
        np.add.at(normals, corner[corner >= 0], area)
        self.inwards = -unit(normals)[self.place]
        # On a disc of radius R, the solution of Poisson's equation is (R^2 - r^2) / 4.
        laplacian = mesh_laplacian(faces, len(vertices)).tocsc()[self.chosen][:, self.chosen]
        weights = vertex_areas(vertices, faces)[self.chosen]
        height = np.maximum(spsolve(laplacian + _HELD * eye(len(self.chosen)), weights), 0)
        self.ball = 2 * np.sqrt(height)
        """(C,) depth of a ball's recess, as deep as it is wide from rim to middle."""
        self.width = np.zeros(count)
        np.maximum.at(self.width, self.place, self.ball)
        self.room = self._half_way()

    def _half_way(self) -> np.ndarray:
        """(C,) from each chosen vertex half of the way to what lies behind it."""
        # From beside the vertices: a ray through an edge of what is behind might meet neither of its faces.
        beside = np.zeros(len(self.vertices), int)
        beside[self.faces] = np.arange(len(self.faces))[:, None]
        middle = self.vertices[self.faces[beside[self.chosen]]].mean(axis=1)
        start = (self.vertices[self.chosen] + middle) / 2
        offset = 1e-4 * np.ptp(self.vertices, axis=0).max()
        behind = cast(self.vertices, self.faces, start + offset * self.inwards, self.inwards, np.inf)[2]
        return np.where(np.isfinite(behind), behind, 0) / 2

    def depths(self, least: float) -> list[float]:
        """From the least one on each twice as deep as the one before, as far as there is room."""
        count = np.log2(max(self.room.max(), least) / least)
        return [least * 2.0**step for step in range(int(np.ceil(count)) + 1)]

    def at(self, depth: np.ndarray | float) -> np.ndarray:
        """(V, 3) vertices of the mesh with recesses of a depth, or of (P,) depths, one for each place."""
        deep = np.broadcast_to(depth, self.width.shape)[self.place]
        walls = self.ball * np.maximum(1, deep / np.maximum(self.width[self.place], np.finfo(float).tiny))
        moved = self.vertices.copy()
        moved[self.chosen] += np.minimum(np.minimum(deep, walls), self.room)[:, None] * self.inwards
        return moved


def put_in_place(
    sdf: np.ndarray,
    points: np.ndarray,
    vertices: np.ndarray,
    moved: np.ndarray,
    faces: np.ndarray,
    cell: float,
) -> tuple[np.ndarray, np.ndarray]:
    """A signed distance whose surface passes through parts that have moved, and is the same elsewhere.

    Args:
        sdf: (n,) in cells, at a lattice's vertices.
        points: (n, 3) where these are.
        vertices, moved: (V, 3) of the template, in the unit of the points, and where they come to be.
        faces: (F, 3), oriented outwards.
        cell: side of a lattice cell, in the same unit.

    Returns:
        (n,) values in cells, and which of them are those of moved parts.
    """
    parts = (moved != vertices).any(axis=1)
    covered = np.asarray(parts[faces].any(axis=1))
    # Walls of recesses are long triangles, whose centres are far from what is beside them.
    fine, small, *_ = trimesh.remesh.subdivide_to_size(moved, faces[covered], cell, max_iter=_HALVINGS)
    mesh = trimesh.Trimesh(fine, np.concatenate([faces[~covered], small]), process=False)
    covered = np.arange(len(mesh.faces)) >= np.count_nonzero(~covered)
    reach = _BAND * cell
    swept = np.concatenate([vertices[parts], moved[parts]])
    low, high = swept.min(axis=0) - reach, swept.max(axis=0) + reach
    near = np.flatnonzero(np.all((points > low) & (points < high), axis=1))
    face = cKDTree(mesh.triangles_center).query(points[near], min(_CANDIDATES, len(mesh.faces)))[1]
    feet = MeshFeet(mesh)(points[near], face)
    inside = _inside(mesh, points[near])
    told = (covered[feet.face] & (feet.distance < reach)) | (inside != (sdf[near] < 0))
    smooth, chosen = np.array(sdf), np.zeros(len(sdf), bool)
    smooth[near[told]] = np.where(inside, -feet.distance, feet.distance)[told] / cell
    chosen[near[told]] = True
    return smooth, chosen


def _inside(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """(n,) whether points are in a closed mesh: it is its back that a ray from there meets first."""
    ahead = np.broadcast_to(_AHEAD, points.shape)
    face, _, distance = cast(mesh.vertices, mesh.faces, points, ahead, np.inf)
    return np.isfinite(distance) & (area_vectors(mesh.vertices, mesh.faces)[face] @ _AHEAD > 0)
