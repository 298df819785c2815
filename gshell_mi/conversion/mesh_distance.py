"""Exact distances from the vertices of a lattice to a triangle mesh nearby, and what their feet tell."""

from dataclasses import dataclass

import drjit as dr
import numpy as np
import trimesh

from ..arrays import Array3f, Float, UInt64
from ..lattice import CubicGrid, Lattice
from ..topology import curve_ids
from ..triangles import unit

_PAIRS = 1 << 22  # vertices times triangles at once: some 200 MiB


def nearest_faces(mesh: trimesh.Trimesh, lattice: Lattice, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """The lattice vertices within ``reach`` of the mesh, and the nearest face of each.

    Every triangle is compared with every lattice vertex in its bounding box, widened by ``reach``. Needs a
    Mitsuba variant to be set.
    """
    import mitsuba as mi

    far = dr.opaque(mi.UInt64, 2**64 - 1)
    # Distance and face in one number, so that one atomic minimum finds both.
    best = dr.zeros(mi.UInt64, lattice.vertex_count) + far
    for grid in lattice.grids:
        _find_nearest(best, mesh.triangles, lattice, grid, reach)
    found = best.numpy()
    vertex = np.flatnonzero(found != 2**64 - 1)
    return vertex, (found[vertex] & 0xFFFFFFFF).astype(np.int64)


def _find_nearest(
    best: UInt64, triangles: np.ndarray, lattice: Lattice, grid: CubicGrid, reach: float
) -> None:
    """Lowers ``best``, at the vertices of one grid, to the squared distance and the number of a triangle."""
    import mitsuba as mi

    low = np.ceil((triangles.min(axis=1) - reach - grid.origin) / grid.spacing).clip(0).astype(int)
    high = np.floor((triangles.max(axis=1) + reach - grid.origin) / grid.spacing)
    high = high.clip(max=grid.stride - 1).astype(int)
    size = np.maximum(high - low + 1, 0)
    first = np.concatenate([[0], np.cumsum(size.prod(axis=1))])
    corners = _corners(triangles)
    lows, sizes = (mi.Point3u(np.ascontiguousarray(part.T, np.uint32)) for part in (low, size))
    start = 0
    while start < len(triangles):
        stop = max(np.searchsorted(first, first[start] + _PAIRS, side="right") - 1, start + 1)
        begins = mi.UInt32(((first[:-1] - first[start]) % 2**32).astype(np.uint32))
        owners = np.repeat(np.arange(start, stop, dtype=np.uint32), np.diff(first[start : stop + 1]))
        owner = mi.UInt32(owners)
        index = dr.arange(mi.UInt32, len(owners)) - dr.gather(mi.UInt32, begins, owner)
        # The lanes that fill the last vector up must not divide by 0.
        box = dr.maximum(dr.gather(mi.Point3u, sizes, owner), 1)
        row = index // box.x
        step = mi.Point3u(index - row * box.x, row % box.y, row // box.y)
        x, y, z = dr.gather(mi.Point3u, lows, owner) + step
        vertex = grid.first + x + grid.stride * (y + grid.stride * z)
        a, b, c = (dr.gather(mi.Point3f, corner, owner) for corner in corners)
        point = mi.Point3f(lattice.positions_of(vertex, mi.Float))
        distance = _squared_distance(mi.Vector3f(point - a), mi.Vector3f(b - a), mi.Vector3f(c - a))
        key = mi.UInt64(dr.reinterpret_array(mi.UInt32, mi.Float(distance))) << 32 | mi.UInt64(owner)
        near = distance <= reach**2
        dr.scatter_reduce(dr.ReduceOp.Min, best, key, vertex, near, dr.ReduceMode.Local)
        dr.eval(best)
        start = stop


def nearest_of(triangles: np.ndarray, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which of its k faces, (n, k), of triangles (F, 3, 3) is nearest to each point. Needs a variant."""
    if faces.shape[1] == 1:
        return faces[:, 0]
    import mitsuba as mi

    corners = _corners(triangles)
    point = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    least, nearest = dr.full(mi.Float, dr.inf, len(points)), dr.zeros(mi.UInt32, len(points))
    for column in faces.T:
        owner = mi.UInt32(np.ascontiguousarray(column, np.uint32))
        a, b, c = (dr.gather(mi.Point3f, corner, owner) for corner in corners)
        distance = _squared_distance(mi.Vector3f(point - a), mi.Vector3f(b - a), mi.Vector3f(c - a))
        nearest = dr.select(distance < least, owner, nearest)
        least = dr.minimum(least, distance)
    return nearest.numpy().astype(np.int64)


def _corners(triangles: np.ndarray) -> list[Array3f]:
    import mitsuba as mi

    return [mi.Point3f(np.ascontiguousarray(triangles[:, i].T, np.float32)) for i in range(3)]


def _squared_distance(p: Array3f, u: Array3f, v: Array3f) -> Float:
    """Squared distance of ``p`` to the triangle (0, u, v)."""

    def to_segment(q: Array3f, direction: Array3f) -> Float:
        t = dr.clip(dr.dot(q, direction) / dr.maximum(dr.squared_norm(direction), 1e-30), 0, 1)
        return dr.squared_norm(q - t * direction)

    border = dr.minimum(dr.minimum(to_segment(p, u), to_segment(p, v)), to_segment(p - u, v - u))
    normal = dr.cross(u, v)
    area = dr.maximum(dr.squared_norm(normal), 1e-30)
    b = dr.dot(dr.cross(p, v), normal) / area
    c = dr.dot(dr.cross(u, p), normal) / area
    above = (b >= 0) & (c >= 0) & (b + c <= 1)
    return dr.select(above, dr.square(dr.dot(p, normal)) / area, border)


@dataclass(frozen=True)
class Feet:
    """The points of a mesh that are nearest to other points."""

    point: np.ndarray
    """(n, 3)."""
    face: np.ndarray
    """(n,): the face that they lie on."""
    distance: np.ndarray
    """(n,), not negative."""
    normal: np.ndarray
    """(n, 3): unit pseudonormals (Baerentzen and Aanaes 2005)."""
    height: np.ndarray
    """(n,): how far the other point lies above the tangent plane."""
    on_rim: np.ndarray
    """(n,): the mesh ends here."""


class MeshFeet:
    """Feet of points on a mesh whose nearest faces are known."""

    def __init__(self, mesh: trimesh.Trimesh):
        self.mesh = mesh
        edges, inverse = np.unique(mesh.edges_sorted, axis=0, return_inverse=True)
        inverse = inverse.reshape(-1)
        uses = np.bincount(inverse)
        self._edge_of_side = inverse.reshape(-1, 3)  # sides (0, 1), (1, 2), (2, 0)
        self._edge_normals = np.zeros((len(edges), 3))
        np.add.at(self._edge_normals, inverse, mesh.face_normals[mesh.edges_face])
        self._edge_on_rim = uses == 1
        self.rim_edges = edges[self._edge_on_rim]
        self._vertex_on_rim = np.zeros(len(mesh.vertices), bool)
        self._vertex_on_rim[self.rim_edges] = True

    def __call__(self, points: np.ndarray, faces: np.ndarray) -> Feet:
        """The feet of (n, 3) points, the nearest face being among the (n, k) given ones."""
        mesh = self.mesh
        face = nearest_of(mesh.triangles, points, faces)
        foot = trimesh.triangles.closest_point(mesh.triangles[face], points)
        weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], foot)
        vanishing = weights < 1e-5
        normal = mesh.face_normals[face].copy()
        on_rim = np.zeros(len(points), bool)
        for i in range(3):
            on_side = vanishing[:, i] & (vanishing.sum(axis=1) == 1)  # opposite to corner i
            edge = self._edge_of_side[face[on_side], (i + 1) % 3]
            normal[on_side] = self._edge_normals[edge]
            on_rim[on_side] = self._edge_on_rim[edge]
            at_corner = ~vanishing[:, i] & (vanishing.sum(axis=1) == 2)
            vertex = mesh.faces[face[at_corner], i]
            normal[at_corner] = mesh.vertex_normals[vertex]
            on_rim[at_corner] = self._vertex_on_rim[vertex]
        normal = unit(normal)
        offset = points - foot
        height = np.einsum("ij,ij->i", offset, normal)
        return Feet(foot, face, np.linalg.norm(offset, axis=1), normal, height, on_rim)

    def rim_samples(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Points along the rims, no farther apart than ``spacing``, (n, 3), and the loops of each, (n,)."""
        start, end = (self.mesh.vertices[self.rim_edges[:, i]] for i in (0, 1))
        steps = np.ceil(np.linalg.norm(end - start, axis=1) / spacing).astype(int) + 1
        edge = np.repeat(np.arange(len(start)), steps)
        t = (np.arange(len(edge)) - np.repeat(np.cumsum(steps) - steps, steps)) / np.repeat(steps, steps)
        return start[edge] + t[:, None] * (end - start)[edge], curve_ids(self.rim_edges)[edge]
