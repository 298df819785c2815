"""Keeping layers apart that the vertices of a lattice cannot tell."""

import mitsuba as mi
import numpy as np
import trimesh

from .. import compat
from ..lattice import Lattice
from ..triangles import unit


def separate_layers(sdf: np.ndarray, mesh: trimesh.Trimesh, lattice: Lattice, band: np.ndarray) -> None:
    """Turns the sign of vertices so that layers with no vertex between them stay apart, in place.

    An edge of the lattice that crosses the mesh twice has ends of one sign. The end nearer to the middle
    between the crossings takes the other sign, which moves the layer in front of it by half an edge at most.
    """
    vertices, faces = _beyond_rims(mesh, lattice.spacing)
    scene = compat.mesh_scene(vertices, faces)
    inner = band[(np.abs(lattice.vertex_positions()[band]) < 1 - 1.5 * lattice.spacing).all(axis=1)]
    spacing = lattice.spacing
    flips = []
    for corner in range(1, 8):
        step = [corner & 1, corner >> 1 & 1, corner >> 2] @ lattice.cell_vectors
        other = lattice.corner(mi.UInt32(inner.astype(np.uint32)), mi.UInt32(corner)).numpy().astype(int)
        alike = (sdf[inner] < 0) == (sdf[other] < 0)
        a, b = inner[alike], other[alike]
        hits = []
        for start, way in ((a, 1), (b, -1)):
            origin = lattice.positions_of(mi.UInt32(start.astype(np.uint32)), mi.Float)
            ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(*(way * step).tolist()))
            ray.maxt = mi.Float(1)
            hits.append(scene.ray_intersect_preliminary(ray).t.numpy())
        twice = np.isfinite(hits[0]) & np.isfinite(hits[1]) & (hits[0] < 1 - hits[1] - 1e-3)
        flips.append(np.where(hits[0] <= hits[1], a, b)[twice])
    flipped = np.unique(np.concatenate(flips))
    depth = np.abs(sdf[flipped]).clip(1e-3 * spacing, 0.1 * spacing)
    sdf[flipped] = np.where(sdf[flipped] < 0, depth, -depth)


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
