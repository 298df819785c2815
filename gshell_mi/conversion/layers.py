"""Keeping layers apart that the vertices of a lattice cannot tell."""

import mitsuba as mi
import numpy as np
import trimesh

from .. import compat
from ..lattice import Lattice
from ..topology import vertex_components
from ..triangles import unit

#: Of a cube's faces, between corners; those from its lowest corner are edges of every lattice.
_OTHER_DIAGONALS = [(1, 2), (1, 4), (2, 4)]

#: Vertices of one sign, at most, that make a bubble.
_BUBBLE = 2


def separate_layers(sdf: np.ndarray, mesh: trimesh.Trimesh, lattice: Lattice, band: np.ndarray) -> None:
    """Turns the sign of vertices so that layers with no vertex between them stay apart, in place.

    An edge of the lattice that crosses the mesh twice has ends of one sign. The end nearer to the middle
    between the crossings takes the other sign, which moves the layer in front of it by half an edge at most.
    One or two vertices that are then alone with their sign would be bubbles of the template, and turn too.
    """
    vertices, faces = _beyond_rims(mesh, lattice.spacing)
    scene = compat.mesh_scene(vertices, faces)
    inner = band[(np.abs(lattice.vertex_positions()[band]) < 1 - 1.5 * lattice.spacing).all(axis=1)]
    spacing = lattice.spacing
    flips = []
    pairs = [(0, corner) for corner in range(1, 8)]
    if lattice.joins_across_faces:
        pairs += _OTHER_DIAGONALS
    start = mi.UInt32(inner.astype(np.uint32))
    for first, last in pairs:
        step = (_steps(last) - _steps(first)) @ lattice.cell_vectors
        a, b = (lattice.corner(start, mi.UInt32(c)).numpy().astype(int) for c in (first, last))
        alike = (sdf[a] < 0) == (sdf[b] < 0)
        a, b = a[alike], b[alike]
        hits = []
        for begin, way in ((a, 1), (b, -1)):
            origin = lattice.positions_of(mi.UInt32(begin.astype(np.uint32)), mi.Float)
            ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(*(way * step).tolist()))
            ray.maxt = mi.Float(1)
            hits.append(scene.ray_intersect_preliminary(ray).t.numpy())
        twice = np.isfinite(hits[0]) & np.isfinite(hits[1]) & (hits[0] < 1 - hits[1] - 1e-3)
        flips.append(np.where(hits[0] <= hits[1], a, b)[twice])
    flipped = np.unique(np.concatenate(flips))
    _turn(sdf, flipped, spacing)
    _turn(sdf, _bubbles(sdf, lattice, band), spacing)


def _turn(sdf: np.ndarray, vertices: np.ndarray, spacing: float) -> None:
    """Changes the sign of vertices, which come to lie close to the surface, in place."""
    depth = np.abs(sdf[vertices]).clip(1e-3 * spacing, 0.1 * spacing)
    sdf[vertices] = np.where(sdf[vertices] < 0, depth, -depth)


def _bubbles(sdf: np.ndarray, lattice: Lattice, band: np.ndarray) -> np.ndarray:
    """Vertices that few others of their sign hang together with: they tell no layers apart."""
    slot = np.full(lattice.vertex_count, -1)
    slot[band] = np.arange(len(band))
    pairs = np.concatenate(
        [
            np.stack([band, x.numpy().astype(int)], axis=1)
            for x in lattice.neighbours(mi.UInt32(band.astype(np.uint32)))
        ]
    )
    pairs = slot[pairs[(sdf[pairs[:, 0]] < 0) == (sdf[pairs[:, 1]] < 0)]]
    piece = vertex_components(pairs[pairs[:, 1] >= 0], len(band))[1]
    return band[np.bincount(piece)[piece] <= _BUBBLE]


def _steps(corner: int) -> np.ndarray:
    """Steps along the cell's vectors to one of its corners."""
    return np.array([corner & 1, corner >> 1 & 1, corner >> 2])


def _beyond_rims(mesh: trimesh.Trimesh, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the mesh, continued past its rims in the tangent plane."""
    single = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    a, b = mesh.edges[single].T
    along = mesh.vertices[b] - mesh.vertices[a]
    outward = np.cross(along, mesh.face_normals[mesh.edges_face[single]])
    direction = np.zeros((len(mesh.vertices), 3))
    for end in (a, b):
        np.add.at(direction, end, outward)
    rim, local = np.unique([a, b], return_inverse=True)
    c, d = local.reshape(2, -1) + len(mesh.vertices)
    strips = np.concatenate([np.stack([b, a, c], axis=1), np.stack([b, c, d], axis=1)])
    beyond = mesh.vertices[rim] + width * unit(direction[rim])
    return np.concatenate([mesh.vertices, beyond]), np.concatenate([mesh.faces, strips])
