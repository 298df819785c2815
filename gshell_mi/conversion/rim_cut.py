"""The mSDF that cuts a template along the rims of the mesh it was made from."""

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

from ..extraction import SurfaceMesh, extract
from ..fields import LatticeFields
from ..lattice import Lattice
from ..topology import equal_patches, mesh_edges, vertex_components
from .bridges import bridges
from .mesh_distance import MeshFeet
from .necks import necks

# A point of the template is on the mesh if it is this near and faces the same way. An edge that crosses
# the mesh is at most sqrt(3) cells long, and its crossing is found to a fraction of it.
_ON_MESH_CELLS = 0.75
_SAME_WAY = -0.5
_SIGN_ROUNDS = 12  # of fitting the mSDF, each with more weight on what has the wrong sign
_DAMPING = 1e-2  # weight of the start of the fit, so that it has one solution
_SPECK = 12  # patches of fewer vertices have the wrong sign
_UNEXPLAINED = 0.02  # as have those of a smaller fraction of the template's vertices and far from any rim
_NECK_CELLS = 6.0  # a rim that became several loops is joined again over no longer a way
_BRIDGE_CELLS = 3.0  # ends of an edge on the surface are no farther from each other along the mesh


def rim_cut(
    fields: LatticeFields, feet_of: MeshFeet, nearest: np.ndarray, rim: np.ndarray, loop: np.ndarray
) -> np.ndarray:
    """The mSDF (n,) that interpolates to the distance to the rims at the vertices of the template, nearly.

    Args:
        fields: hold the sdf.
        feet_of: of the mesh.
        nearest: the face nearest to each lattice vertex, -1 where it is far.
        rim: samples of the rims, (n, 3).
        loop: the rim that each sample is on, (n,).
    """
    lattice = fields.lattice
    template = extract(lattice, mi.Float(fields.sdf))
    assert isinstance(lattice, Lattice) and template.stencil is not None
    vertices, faces, _ = template.to_numpy()
    edges, _ = mesh_edges(faces)
    rims = cKDTree(rim)
    normals = np.array(dr.detach(template.vertex_normals())).T
    wanted, beside_rim, cut = _rim_distance(vertices, normals, faces, edges, lattice, feet_of, nearest, rims)
    entries = [tuple(np.array(x) for x in entry) for entry in dr.detach(template.stencil.entries())]
    row, column, weight = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    used, column = np.unique(column, return_inverse=True)
    interpolate = coo_array((weight, (row, column)), shape=(template.vertex_count, len(used))).tocsr()
    # The least change of the mean of what the lattice vertex takes part in.
    share = interpolate.T @ np.ones(template.vertex_count)
    start = (interpolate.T @ wanted) / share
    importance = np.ones(template.vertex_count)
    values = start

    def at_lattice(values: np.ndarray) -> np.ndarray:
        msdf = np.full(lattice.vertex_count, -lattice.spacing, np.float32)
        msdf[used] = values
        return msdf

    for turn in range(_SIGN_ROUNDS):
        normal = interpolate.T @ diags_array(importance) @ interpolate + _DAMPING * diags_array(share)
        right = interpolate.T @ (importance * wanted) + _DAMPING * share * start
        jacobi = diags_array(1 / normal.diagonal())
        values, _ = cg(normal.tocsr(), right, x0=values, rtol=1e-4, maxiter=150, M=jacobi)
        found = interpolate @ values
        patches = _Patches(found, faces)
        speck = patches.specks(wanted)
        speck &= (found > 0) | ~patches.holding(cut)  # what has been cut stays cut
        # Where caps and layers share lattice vertices, caps prevail at the rims, so that these do not run
        # into each other, and the mesh elsewhere. Nothing small is left over.
        missed = ((found > 0) != (wanted > 0)) & (beside_rim != (wanted > 0))
        settled = not speck.any() and not missed.any()
        # Rims are looked at once the signs are right, or the fit has had its time to set them right.
        neck = np.zeros(0, int)
        if settled or turn >= _SIGN_ROUNDS / 2:
            border, of_loop = _loops(extract(lattice, mi.Float(fields.sdf), mi.Float(at_lattice(values))))
            neck = necks(
                vertices,
                edges,
                found > 0,
                border,
                of_loop,
                loop[rims.query(border)[1]],
                _NECK_CELLS * lattice.spacing,
            )
            cut[neck], wanted[neck] = True, -0.25 * lattice.spacing
        if settled and not len(neck):
            break
        importance[missed] *= 8
        wanted[speck] = np.where(found[speck] > 0, -0.25, 0.25) * lattice.spacing
        importance[speck] *= 8
        importance[neck] *= 8
    for _ in range(_SIGN_ROUNDS):  # what the fit could not remove goes by force
        found = interpolate @ values
        speck = np.flatnonzero(_Patches(found, faces).specks(wanted))
        if len(speck) == 0:
            break
        ends = interpolate[speck].tocoo()
        turned = np.copysign(0.1 * lattice.spacing, -found[speck])
        values[ends.coords[1]] = turned[ends.coords[0]]
    return at_lattice(values)


def _loops(surface: SurfaceMesh) -> tuple[np.ndarray, np.ndarray]:
    """The vertices on the boundary of a surface, (n, 3), and the loop that each is on, (n,)."""
    vertices, faces, _ = surface.to_numpy()
    edges, uses = mesh_edges(faces)
    ends, local = np.unique(edges[uses == 1], return_inverse=True)
    return vertices[ends], vertex_components(local.reshape(-1, 2), len(ends))[1]


def _rim_distance(
    vertices: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    edges: np.ndarray,
    lattice: Lattice,
    feet_of: MeshFeet,
    nearest: np.ndarray,
    rims: cKDTree,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signed distance to the rims along the mesh at the vertices of the template, which of these are near
    a rim, and which are cut as they lead from one layer to another."""
    h = lattice.spacing
    strides = np.array([1, lattice.stride, lattice.stride**2])
    cube = np.array(list(np.ndindex(2, 2, 2))) @ strides
    corners = []
    for grid in lattice.grids:
        low = np.clip(np.floor((vertices - grid.origin) / h).astype(int), 0, grid.stride - 2)
        corners.append(grid.first + (low @ strides)[:, None] + cube)
    candidates = nearest[np.concatenate(corners, axis=1)]
    known = np.asarray((candidates >= 0).any(axis=1))
    candidates = np.where(candidates >= 0, candidates, candidates.max(axis=1, keepdims=True))
    feet = feet_of(vertices[known].astype(float), candidates[known])
    inner = rims.query(feet.point)[0]
    on_mesh = (feet.distance < _ON_MESH_CELLS * h) & ((feet.normal * normals[known]).sum(axis=1) > _SAME_WAY)
    wanted = np.full(len(vertices), -2 * h)
    past = -np.maximum(feet.distance, h / 4)
    wanted[known] = np.where(feet.on_rim, -feet.distance, np.where(on_mesh, inner, past))
    wanted = np.clip(wanted, -2 * h, 2 * h)
    beside_rim = np.zeros(len(vertices), bool)
    beside_rim[known] = inner < 2 * h
    for _ in range(2):
        # What no rim explains comes from layers that the lattice cannot tell apart, or from a crease.
        patches = _Patches(wanted, faces)
        small = (patches.size < _UNEXPLAINED * len(wanted))[patches.of_vertex]
        tiny = (patches.size < _SPECK)[patches.of_vertex]
        wanted[tiny | (small & ~patches.holding(beside_rim))] *= -1
    sheet = (wanted[edges] > 0).all(axis=1) & beside_rim[edges].any(axis=1) & known[edges].all(axis=1)
    leaps = bridges(feet_of.mesh, feet, (np.cumsum(known) - 1)[edges[sheet]], _BRIDGE_CELLS * h)
    # They are cut at the end that is nearer to a rim.
    nearer = np.take_along_axis(leaps, inner[leaps].argmin(axis=1)[:, None], axis=1)
    cut = np.zeros(len(vertices), bool)
    cut[np.flatnonzero(known)[nearer]] = True
    wanted[cut] = -h / 4
    return np.copysign(np.maximum(np.abs(wanted), 1e-3 * h), wanted), beside_rim, cut


class _Patches:
    """The connected patches of one sign that the template's vertices with these values fall into."""

    def __init__(self, values: np.ndarray, faces: np.ndarray):
        self.positive = values > 0
        self.of_vertex = equal_patches(self.positive, faces)
        self.size: np.ndarray = np.bincount(self.of_vertex)

    def specks(self, wanted: np.ndarray) -> np.ndarray:
        """Which vertices lie in patches that are too small, or mostly of a sign that they should not have."""
        wrong = np.bincount(self.of_vertex, self.positive != (wanted > 0))
        return ((self.size < _SPECK) | (wrong > self.size / 2))[self.of_vertex]

    def holding(self, chosen: np.ndarray) -> np.ndarray:
        """Which vertices lie in a patch that holds a chosen vertex."""
        return (np.bincount(self.of_vertex, chosen) > 0)[self.of_vertex]
