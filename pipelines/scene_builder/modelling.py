"""Implicit modelling: signed distance functions to triangle meshes, and meshes cut by a scalar field.

A *distance function* here maps points ``(n, 3)`` to ``(n,)``, negative inside, with a gradient near 1.
"""

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import skimage.measure
import trimesh
from scipy.interpolate import PchipInterpolator

Field = Callable[[np.ndarray], np.ndarray]


def smooth_union(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """The polynomial smooth minimum (Quilez): a blend of radius about ``k``."""
    h = np.clip(k - np.abs(a - b), 0, None) / k
    return np.minimum(a, b) - h * h * k / 4


def smooth_step(x: np.ndarray, lo: float, hi: float) -> np.ndarray:
    """Hermite step from 0 at ``lo`` to 1 at ``hi``."""
    t = np.clip((x - lo) / (hi - lo), 0, 1)
    return t * t * (3 - 2 * t)


def mirrored(p: np.ndarray) -> np.ndarray:
    """Points folded to x >= 0, which makes what is modelled there left-right symmetric."""
    return np.abs(p) * [1, 0, 0] + p * [0, 1, 1]


def segment(p: np.ndarray, a, b) -> tuple[np.ndarray, np.ndarray]:
    """Distance to the segment ``ab``, and the parameter in [0, 1] of the nearest point on it."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(p - a - t[:, None] * (b - a), axis=1), t


def capsule(p: np.ndarray, a, b, r0: float, r1: float | None = None) -> np.ndarray:
    """A tube from ``a`` (radius ``r0``) to ``b`` (radius ``r1``) with round ends."""
    d, t = segment(p, a, b)
    return d - (r0 + t * ((r0 if r1 is None else r1) - r0))


def ellipsoid(p: np.ndarray, centre, radii) -> np.ndarray:
    """Distance to an ellipsoid, to first order."""
    q = (p - np.asarray(centre)) / np.asarray(radii)
    k = np.linalg.norm(q, axis=1)
    return k * (k - 1) / np.maximum(np.linalg.norm(q / np.asarray(radii), axis=1), 1e-9)


def torus(p: np.ndarray, centre, axis, major: float, minor: float) -> np.ndarray:
    """A ring around ``axis``."""
    q, axis = p - np.asarray(centre), np.asarray(axis, float) / np.linalg.norm(axis)
    h = q @ axis
    return np.hypot(np.linalg.norm(q - h[:, None] * axis, axis=1) - major, h) - minor


def gradient(f: Field, p: np.ndarray, h: float = 1e-4) -> np.ndarray:
    """Central differences of ``f``."""
    e = h * np.eye(3)
    return np.stack([f(p + e[i]) - f(p - e[i]) for i in range(3)], 1) / (2 * h)


def project(f: Field, p: np.ndarray, steps: int = 3) -> np.ndarray:
    """Newton steps onto the zero set of ``f``."""
    for _ in range(steps):
        g = gradient(f, p)
        p = p - (f(p) / np.maximum((g * g).sum(1), 1e-9))[:, None] * g
    return p


def isosurface(f: Field, lo, hi, cell: float) -> trimesh.Trimesh:
    """Marching cubes on the box ``lo`` .. ``hi``, faces turned outwards."""
    lo, hi = np.asarray(lo, float), np.asarray(hi, float)
    n = np.ceil((hi - lo) / cell).astype(int) + 1
    axes = [lo[i] + cell * np.arange(n[i]) for i in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    value = f(grid).reshape(n)
    # A zero at a grid point would leave faces without area.
    value = np.where(np.abs(value) < 1e-3 * cell, 1e-3 * cell, value)
    v, faces, _, _ = skimage.measure.marching_cubes(value, 0.0, spacing=(cell,) * 3)
    return trimesh.Trimesh(v + lo, faces, process=True)


def cut(mesh: trimesh.Trimesh, nu: np.ndarray, *, islands: bool = False) -> trimesh.Trimesh:
    """The part ``{nu >= 0}`` of a mesh; ``nu`` is given per vertex and interpolated along edges.

    Of a part in several pieces only the largest is kept, unless ``islands``. Boundary vertices are shared by
    the triangles they bound, so the result is welded.
    """
    # A vertex almost on the cut would leave slivers: decide it to be inside.
    nu = np.where(np.abs(nu) < 1e-9, 1e-9, nu)
    v, f = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    inside = nu >= 0
    count = inside[f].sum(1)
    # Turn each crossed triangle so that its odd vertex out comes first.
    crossed = f[(count == 1) | (count == 2)]
    odd = np.where(inside[crossed].sum(1, keepdims=True) == 1, inside[crossed], ~inside[crossed]).argmax(1)
    tri = np.take_along_axis(crossed, (odd[:, None] + np.arange(3)) % 3, 1)
    edges = np.sort(np.concatenate([tri[:, [0, 1]], tri[:, [0, 2]]]), 1)
    edges, index = np.unique(edges, axis=0, return_inverse=True)
    i, j = edges.T
    t = (nu[i] / (nu[i] - nu[j]))[:, None]
    new = v[i] + t * (v[j] - v[i])
    ab, ac = len(v) + index.reshape(2, -1)
    a, b, c = tri.T
    one = inside[a]
    faces = np.concatenate(
        [
            f[count == 3],
            np.stack([a, ab, ac], 1)[one],
            np.stack([ab, b, c], 1)[~one],
            np.stack([ab, c, ac], 1)[~one],
        ]
    )
    part = trimesh.Trimesh(np.concatenate([v, new]), faces, process=True)
    # Where the cut runs through a vertex, triangles have shrunk to points and lines.
    part.update_faces(part.nondegenerate_faces())
    part.remove_unreferenced_vertices()
    return part if islands else largest_component(part)


def largest_component(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The part of a mesh with the greatest area."""
    return max(mesh.split(only_watertight=False), key=lambda part: part.area)


def boundary_vertices(mesh: trimesh.Trimesh) -> np.ndarray:
    """A mask of the vertices on open edges."""
    edges, count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    mask = np.zeros(len(mesh.vertices), bool)
    mask[edges[count == 1].ravel()] = True
    return mask


def relax(mesh: trimesh.Trimesh, f: Field, nu: Field | None = None, steps: int = 20) -> trimesh.Trimesh:
    """Evens out triangles: tangential Laplacian smoothing on ``{f = 0}``, rims kept on ``{nu = 0}``."""
    v, n = np.asarray(mesh.vertices).copy(), len(mesh.vertices)
    edges, count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    rim = boundary_vertices(mesh)
    # A rim vertex moves along the rim: only its two rim neighbours count.
    keep = edges[(count == 1) | ~(rim[edges].any(1))]
    inner = edges[(count == 2) & rim[edges].any(1)]
    rows = np.concatenate([keep[:, 0], keep[:, 1], inner[:, 0], inner[:, 1]])
    cols = np.concatenate([keep[:, 1], keep[:, 0], inner[:, 1], inner[:, 0]])
    used = ~rim[rows] | (np.arange(len(rows)) < 2 * len(keep))
    a = sp.csr_matrix((np.ones(used.sum()), (rows[used], cols[used])), shape=(n, n))
    a = sp.diags(1 / np.ravel(a.sum(1))) @ a
    for _ in range(steps):
        v = project(f, v + 0.5 * (a @ v - v), 1)
        if nu is not None and rim.any():
            w = v[rim]
            for _ in range(2):
                w = project(f, project(nu, w, 1), 1)
            v[rim] = w
    return trimesh.Trimesh(v, mesh.faces, process=False)


def even_profile(points: np.ndarray, n: int) -> np.ndarray:
    """``n`` points evenly spaced along a smooth curve through ``points``, all ``(.., 2)``: radius, height."""
    along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    dense = PchipInterpolator(along, points)(np.linspace(0, along[-1], 4000))
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))]
    at = np.linspace(0, length[-1], n)
    return np.stack([np.interp(at, length, dense[:, i]) for i in range(2)], 1)


def revolve(profile: np.ndarray, sides: int) -> trimesh.Trimesh:
    """Turns a profile that starts on the axis about y; one pole, one open rim, faces outwards."""
    n = len(profile) - 1
    phi = np.arange(sides) / sides * 2 * np.pi
    r, y = profile[1:, :1], profile[1:, 1:]
    ring = np.stack([r * np.cos(phi), np.broadcast_to(y, (n, sides)), r * np.sin(phi)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    quads = np.stack([a, a + sides, b + sides, a, b + sides, b], -1).reshape(-1, 3)
    j = np.arange(sides)
    pole = np.stack([np.full(sides, n * sides), j, (j + 1) % sides], 1)
    vertices = np.concatenate([ring, [[0, profile[0, 1], 0]]])
    return trimesh.Trimesh(vertices, np.concatenate([quads, pole]), process=False)
