"""Fields of a triangle mesh, closed or open, to start from."""

from pathlib import Path

import drjit as dr
import numpy as np
import trimesh
from scipy import ndimage
from scipy.fft import dstn, idstn
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

from .. import compat
from ..errors import UserError
from ..extraction import SurfaceMesh, extract
from ..fields import LatticeFields
from ..lattice import CubicGrid, Lattice
from ..topology import vertex_components
from .bridges import bridges
from .mesh_distance import Feet, MeshFeet, nearest_faces

_BAND_CELLS = 3.0  # distances are exact and signs those of the nearest face this near the mesh
# Past a rim the template goes on in the tangent plane for this long, so that the mSDF cuts it cleanly.
_RIM_CELLS = 2.0
# A point of the template is on the mesh if it is this near and faces the same way. An edge that crosses
# the mesh is at most sqrt(3) cells long, and its crossing is found to a fraction of it.
_ON_MESH_CELLS = 0.75
_SAME_WAY = -0.5
_SIGN_ROUNDS = 12  # of fitting the mSDF, each with more weight on what has the wrong sign
_DAMPING = 1e-2  # weight of the start of the fit, so that it has one solution
_SPECK = 12  # patches of fewer vertices have the wrong sign
_UNEXPLAINED = 0.02  # as have those of a smaller fraction of the template's vertices and far from any rim
_BRIDGE_CELLS = 3.0  # ends of an edge on the surface are no farther from each other along the mesh


def from_mesh(
    source: str | Path | trimesh.Trimesh, lattice: Lattice, *, to_world: np.ndarray | None = None
) -> LatticeFields:
    """Fields whose surface is the mesh, to the accuracy of the lattice. Needs a Mitsuba variant to be set.

    Near the mesh ``sdf`` is the distance to it, signed by the pseudonormal of the nearest point (Baerentzen
    and Aanaes 2005). Farther away, and across openings, the sign is that of the generalised winding number
    (Jacobson et al. 2013) as a harmonic function on the lattice that jumps by 1 across the mesh, which caps
    the openings. ``msdf`` is fitted, at the vertices of the template that results, to the distance to the
    rims along the mesh, negative past them and on the caps. An open mesh must be consistently oriented.
    Layers closer to each other than about two cells run into each other here and there, but their rims stay
    apart as far as the lattice can tell them.

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
    feet_of = MeshFeet(mesh)
    band, face = nearest_faces(mesh, lattice, _BAND_CELLS * h)
    feet = feet_of(points[band], face[:, None])

    far = _far_distance(lattice, points, band, feet)
    winding = np.concatenate([_winding_number(grid, mesh) for grid in lattice.grids])
    sdf = np.where(winding > 0.5, -far, far)
    near = np.where(feet.height < 0, -feet.distance, feet.distance)
    near[feet.on_rim] = np.copysign(feet.distance, sdf[band])[feet.on_rim]
    beside_rim = feet.on_rim & (feet.distance < _RIM_CELLS * h)
    near[beside_rim] = feet.height[beside_rim]
    sdf[band] = near
    if not mesh.is_watertight:
        _separate_layers(sdf, mesh, lattice, band)
    border = lattice.on_border()
    sdf[border] = np.maximum(np.abs(sdf), h / 2)[border]  # the template closes inside the lattice

    fields = LatticeFields.closed(sdf, lattice.grid)
    rim = feet_of.rim_samples(h / 8)
    if len(rim) == 0:
        return fields
    nearest = np.full(lattice.vertex_count, -1)
    nearest[band] = face
    msdf = _fitted_msdf(fields, feet_of, nearest, rim)
    return LatticeFields(fields.sdf, msdf, fields.deform, lattice.grid)


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
    mesh = _without_pinches(mesh)
    if mesh.is_watertight and mesh.volume < 0:
        mesh.invert()
    return mesh


def _without_pinches(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same faces, with a vertex of its own for each fan of faces that meets others in a point only.

    So may cloth that touches itself come out of a file, where equal positions are one vertex.
    """
    corner = np.arange(3 * len(mesh.faces)).reshape(-1, 3)
    side = np.stack([corner, np.roll(corner, -1, axis=1)], axis=-1).reshape(-1, 2)
    ends = mesh.faces.ravel()[side]
    side = np.take_along_axis(side, ends.argsort(axis=1), axis=1)
    _, first, edge = np.unique(np.sort(ends, axis=1), axis=0, return_index=True, return_inverse=True)
    # Faces that share an edge share its ends.
    same = np.stack([side, side[first[edge.reshape(-1)]]], axis=-1).reshape(-1, 2)
    _, chosen, faces = np.unique(vertex_components(same, corner.size)[1], return_index=True,
                                 return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[mesh.faces.ravel()[chosen]], faces.reshape(-1, 3), process=False)


def _far_distance(lattice: Lattice, points: np.ndarray, band: np.ndarray, feet: Feet) -> np.ndarray:
    """Distances of all lattice vertices to the foot of the nearest vertex beside the mesh."""
    beside = feet.distance < lattice.spacing
    away = np.ones(lattice.vertex_count, bool)
    away[band[beside]] = False
    shape = (lattice.stride,) * 3
    foot = np.zeros((lattice.vertex_count, 3))
    foot[band] = feet.point
    nearest = [grid.first + np.ravel_multi_index(tuple(ndimage.distance_transform_edt(
        away[grid.ids].reshape(shape), return_distances=False, return_indices=True)), shape).ravel()
        for grid in lattice.grids]
    return np.linalg.norm(points - foot[np.concatenate(nearest)], axis=1)


def _separate_layers(sdf: np.ndarray, mesh: trimesh.Trimesh, lattice: Lattice, band: np.ndarray) -> None:
    """Turns the sign of vertices so that layers with no vertex between them stay apart, in place.

    An edge of the lattice that crosses the mesh twice has ends of one sign. The end nearer to the middle
    between the crossings takes the other sign, which moves the layer in front of it by half an edge at most.
    """
    import mitsuba as mi

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
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-30)
    rim, local = np.unique([a, b], return_inverse=True)
    c, d = local.reshape(2, -1) + len(mesh.vertices)
    strips = np.concatenate([np.stack([b, a, c], axis=1), np.stack([b, c, d], axis=1)])
    beyond = mesh.vertices[rim] + width * direction[rim]
    return np.concatenate([mesh.vertices, beyond]), np.concatenate([mesh.faces, strips])


def _fitted_msdf(
    fields: LatticeFields, feet_of: MeshFeet, nearest: np.ndarray, rim: np.ndarray
) -> np.ndarray:
    """The mSDF whose interpolation at the vertices of the template is nearest to the distance to the rims.

    Args:
        nearest: the face nearest to each lattice vertex, -1 where it is far.
        rim: samples of the rims, (n, 3).
    """
    import mitsuba as mi

    lattice = fields.lattice
    template = extract(lattice, mi.Float(fields.sdf))
    edges = template.to_numpy()[1][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    wanted, beside_rim, cut = _rim_distance(template, lattice, feet_of, nearest, rim, edges)
    entries = [tuple(np.array(x) for x in entry) for entry in dr.detach(template.stencil.entries())]
    row, column, weight = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    used, column = np.unique(column, return_inverse=True)
    interpolate = coo_array((weight, (row, column)), shape=(template.vertex_count, len(used))).tocsr()
    # The least change of the mean of what the lattice vertex takes part in.
    share = interpolate.T @ np.ones(template.vertex_count)
    start = (interpolate.T @ wanted) / share
    importance = np.ones(template.vertex_count)
    values = start
    for _ in range(_SIGN_ROUNDS):
        normal = interpolate.T @ diags_array(importance) @ interpolate + _DAMPING * diags_array(share)
        right = interpolate.T @ (importance * wanted) + _DAMPING * share * start
        jacobi = diags_array(1 / normal.diagonal())
        values, _ = cg(normal.tocsr(), right, x0=values, rtol=1e-4, maxiter=150, M=jacobi)
        found = interpolate @ values
        speck = _specks(found, wanted, edges)
        # A cut between layers that ends within the sheet is a pin-hole: it grows until it meets a cap.
        short = speck & (found < 0) & _in_patches_of(cut, found, edges)
        if short.any():
            speck &= ~short
            grown = edges[short[edges].any(axis=1)].ravel()
            cut[grown], wanted[grown] = True, -0.25 * lattice.spacing
        # Where caps and layers share lattice vertices, caps prevail at the rims, so that these do not run
        # into each other, and the mesh elsewhere. Nothing small is left over.
        missed = ((found > 0) != (wanted > 0)) & (beside_rim != (wanted > 0))
        if not speck.any() and not missed.any() and not short.any():
            break
        importance[missed] *= 8
        wanted[speck] = np.where(found[speck] > 0, -0.25, 0.25) * lattice.spacing
        importance[speck] *= 8
    for _ in range(_SIGN_ROUNDS):  # what the fit could not remove goes by force
        found = interpolate @ values
        speck = np.flatnonzero(_specks(found, wanted, edges))
        if len(speck) == 0:
            break
        ends = interpolate[speck].tocoo()
        turned = np.copysign(0.1 * lattice.spacing, -found[speck])
        values[ends.coords[1]] = turned[ends.coords[0]]
    msdf = np.full(lattice.vertex_count, -lattice.spacing, np.float32)
    msdf[used] = values
    return msdf


def _rim_distance(
    template: SurfaceMesh, lattice: Lattice, feet_of: MeshFeet, nearest: np.ndarray, rim: np.ndarray,
    edges: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signed distance to the rims along the mesh at the vertices of the template, which of these are near
    a rim, and which are cut as they lead from one layer to another."""
    h = lattice.spacing
    vertices = template.to_numpy()[0]
    normals = np.array(dr.detach(template.vertex_normals())).T
    strides = np.array([1, lattice.stride, lattice.stride**2])
    cube = np.array(list(np.ndindex(2, 2, 2))) @ strides
    corners = []
    for grid in lattice.grids:
        low = np.clip(np.floor((vertices - grid.origin) / h).astype(int), 0, grid.stride - 2)
        corners.append(grid.first + (low @ strides)[:, None] + cube)
    candidates = nearest[np.concatenate(corners, axis=1)]
    known = (candidates >= 0).any(axis=1)
    candidates = np.where(candidates >= 0, candidates, candidates.max(axis=1, keepdims=True))
    feet = feet_of(vertices[known].astype(float), candidates[known])
    inner = cKDTree(rim).query(feet.point)[0]
    on_mesh = (feet.distance < _ON_MESH_CELLS * h) & ((feet.normal * normals[known]).sum(axis=1) > _SAME_WAY)
    wanted = np.full(len(vertices), -2 * h)
    past = -np.maximum(feet.distance, h / 4)
    wanted[known] = np.where(feet.on_rim, -feet.distance, np.where(on_mesh, inner, past))
    wanted = np.clip(wanted, -2 * h, 2 * h)
    beside_rim = np.zeros(len(vertices), bool)
    beside_rim[known] = inner < 2 * h
    for _ in range(2):
        # What no rim explains comes from layers that the lattice cannot tell apart, or from a crease.
        patch = _patches(wanted > 0, edges)
        size, explained = np.bincount(patch), np.bincount(patch, beside_rim) > 0
        wanted[((size < _SPECK) | (~explained & (size < _UNEXPLAINED * len(wanted))))[patch]] *= -1
    sheet = (wanted[edges] > 0).all(axis=1) & beside_rim[edges].any(axis=1) & known[edges].all(axis=1)
    leaps = bridges(feet_of.mesh, feet, (np.cumsum(known) - 1)[edges[sheet]], _BRIDGE_CELLS * h)
    # They are cut at the end that is nearer to a rim.
    nearer = np.take_along_axis(leaps, inner[leaps].argmin(axis=1)[:, None], axis=1)
    cut = np.zeros(len(vertices), bool)
    cut[np.flatnonzero(known)[nearer]] = True
    wanted[cut] = -h / 4
    return np.copysign(np.maximum(np.abs(wanted), 1e-3 * h), wanted), beside_rim, cut


def _specks(found: np.ndarray, wanted: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Which vertices lie in patches that are too small, or mostly of a sign that they should not have."""
    patch = _patches(found > 0, edges)
    size, wrong = np.bincount(patch), np.bincount(patch, (found > 0) != (wanted > 0))
    return ((size < _SPECK) | (wrong > size / 2))[patch]


def _in_patches_of(chosen: np.ndarray, found: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Which vertices lie in a patch of one sign that holds a chosen vertex."""
    patch = _patches(found > 0, edges)
    return (np.bincount(patch, chosen) > 0)[patch]


def _patches(positive: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The connected patch of one sign that each vertex belongs to."""
    alike = positive[edges[:, 0]] == positive[edges[:, 1]]
    return vertex_components(edges[alike], len(positive))[1]


def _winding_number(grid: CubicGrid, mesh: trimesh.Trimesh) -> np.ndarray:
    """The generalised winding number w at the vertices of a grid, blurred by about a cell.

    It is harmonic but for its jump across the mesh: laplace(w) = -div(n delta)
    (Barill et al. 2018, sec. 2), solved on the grid with w = 0 on its border, as by Kazhdan et al. (2006).
    """
    n, h = grid.stride, grid.spacing
    count = int(np.clip(6 * mesh.area / h**2, 20_000, 1_000_000))
    samples, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    area_normals = mesh.face_normals[faces] * mesh.area / count
    cell = (samples - grid.origin) / h
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
        return np.zeros(n**3)
    inner = slice(1, -1)
    eigenvalue = (2 - 2 * np.cos(np.pi * np.arange(1, n - 1) / (n - 1))) / h**2
    total = eigenvalue[:, None, None] + eigenvalue[:, None] + eigenvalue
    winding = np.zeros((n, n, n))
    winding[inner, inner, inner] = idstn(dstn(divergence[inner, inner, inner], type=1) / total, type=1)
    return winding.ravel()
