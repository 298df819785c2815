"""Where the surface is instead of what closes an opening: caps as smooth as what is around them, recesses.

Nobody sees a cap, so nothing has shaped it: it is where the hull was, which may bulge from a surface that the
images have moved since. What would close the opening is better told by its surroundings. And what seems to be
an opening may be something that lies deeper.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import diags, eye
from scipy.sparse.linalg import spsolve

from ..fields.smoothing import mesh_laplacian
from ..topology import equal_patches
from ..triangles import area_vectors, unit, vertex_areas
from .sides import cast

#: Walls of a recess as deep as wide from rim to middle, by those of a ball: its floor has three quarters of
#: its area.
_STEEP = 2.0

#: Share of the way to another side after which a lid lies on it: after all of it both would be one.
_NEARLY = 0.9

#: What holds a cap without surroundings in place, as a share of what bends it.
_HELD = 1e-6


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


def facing_one_way(vertices: np.ndarray, faces: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(V,) ids of the connected patches that places of a mesh fall into, if each shall face one way.

    A recess goes in one way, and what is proposed may go around an edge. Both ways are those of the principal
    axis of a place's normals.

    Args:
        vertices, faces: of the mesh.
        place: (V,) which place a vertex is in, from 0; -1 if in none.
    """
    chosen = np.flatnonzero(place >= 0)
    normals = np.zeros((len(vertices), 3))
    np.add.at(normals, faces, area_vectors(vertices, faces)[:, None])
    normals, owner = unit(normals)[chosen], place[chosen]
    spread = np.zeros((int(place.max()) + 1, 3, 3))
    weights = vertex_areas(vertices, faces)[chosen, None, None]
    np.add.at(spread, owner, weights * normals[:, :, None] * normals[:, None])
    axis = np.linalg.eigh(spread)[1][:, :, -1]
    side = np.full(len(vertices), -1)
    side[chosen] = 2 * owner + (np.einsum("ni,ni->n", normals, axis[owner]) > 0)
    return equal_patches(side, faces)


class Recesses:
    """Places of a mesh pushed in along their mean normals: flat floors, and walls twice as steep as a ball's.

    A recess ends half-way to what lies behind it: one that reaches that is an opening.

    Args:
        vertices, faces: of the mesh, oriented outwards.
        place: (V,) which of the places, at least one, a vertex is in, from 0; -1 if in none.
        kept: thickness that a recess leaves, at least, if there is as much.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, place: np.ndarray, kept: float = 0):
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
        behind = self._behind()
        self.room = np.minimum(behind / 2, np.maximum(behind - kept, 0))

    def _behind(self) -> np.ndarray:
        """(C,) way from each chosen vertex to what lies behind it; 0 where nothing does."""
        # From beside the vertices: a ray through an edge of what is behind might meet neither of its faces.
        beside = np.zeros(len(self.vertices), int)
        beside[self.faces] = np.arange(len(self.faces))[:, None]
        middle = self.vertices[self.faces[beside[self.chosen]]].mean(axis=1)
        start = (self.vertices[self.chosen] + middle) / 2
        offset = 1e-4 * np.ptp(self.vertices, axis=0).max()
        face, _, distance = cast(
            self.vertices, self.faces, start + offset * self.inwards, self.inwards, np.inf
        )
        # What is met first from inside is a back.
        within = np.einsum("ni,ni->n", area_vectors(self.vertices, self.faces)[face], self.inwards) > 0
        return np.where(within & np.isfinite(distance), distance, 0)

    def depths(self, least: float) -> list[float]:
        """From the least one on each twice as deep as the one before, as far as there is room."""
        count = np.log2(max(self.room.max(), least) / least)
        return [least * 2.0**step for step in range(int(np.ceil(count)) + 1)]

    def at(self, depth: np.ndarray | float) -> np.ndarray:
        """(V, 3) vertices of the mesh with recesses of a depth, or of (P,) depths, one for each place."""
        deep = np.broadcast_to(depth, self.width.shape)[self.place]
        width = np.maximum(self.width[self.place], np.finfo(float).tiny)
        walls = _STEEP * self.ball * np.maximum(1, deep / width)
        moved = self.vertices.copy()
        moved[self.chosen] += np.minimum(np.minimum(deep, walls), self.room)[:, None] * self.inwards
        return moved

    def on_other_sides(self, thickness: float) -> np.ndarray:
        """(V, 3) vertices of the mesh laid on what lies behind them, as far as walls allow, where that is no
        farther than a thickness."""
        way, far = self.at(0.5 * thickness) - self.vertices, self.chosen[2 * self.room > thickness]
        way[far] = 0
        return self.vertices + _NEARLY * 2 * way
