"""Rays from a template's vertices to its other side."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from ..compat import mesh_scene

#: Parts of a template are thin up to this thickness, in cells: a sheet, and a cell on either side of it.
THIN = 2.0


def opposite_sides(
    before: np.ndarray, moved: np.ndarray, faces: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Thickness of a template under each vertex, and what is on its other side.

    Two sides that were opposite each other and moved through each other have a negative thickness; rays in
    the moved template alone would take them for the outside.

    Args:
        before, moved: (V, 3) positions.
        faces: (F, 3) of the watertight template, oriented outwards.
        cell: side of a lattice cell, in the positions' unit.

    Returns:
        (V,) thickness after the movement, infinite if there is no other side within ``THIN`` cells; (V,)
        nearest vertex of the other side, arbitrary then.
    """
    offset = 1e-3 * cell
    normals = normals_at_vertices(moved, faces)
    thickness, opposite = np.full(len(moved), np.inf), np.zeros(len(moved), int)
    for positions in (before, moved):
        inwards = -normals_at_vertices(positions, faces)
        face, weights, distance = cast(positions, faces, positions + offset * inwards, inwards, THIN * cell)
        point = np.einsum("ni,nij->nj", weights, moved[faces[face]])
        depth = np.where(np.isfinite(distance), np.einsum("nj,nj->n", moved - point, normals), np.inf)
        nearer = depth < thickness
        thickness[nearer] = depth[nearer]
        opposite[nearer] = faces[face, weights.argmax(axis=1)][nearer]
    return thickness, opposite


def cast(
    vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Face, barycentric weights (0 without a hit) and distance (infinite then) of rays on a mesh."""
    o, d = (np.ascontiguousarray(x.T, np.float32) for x in (origins, directions))
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d), dr.opaque(mi.Float, reach), 0, [])
    hit = mesh_scene(vertices, faces).ray_intersect_preliminary(ray, coherent=False)
    valid, uv = hit.is_valid().numpy(), hit.prim_uv.numpy().T
    weights = np.where(valid[:, None], np.column_stack([1 - uv.sum(axis=1), uv]), 0)
    return np.where(valid, hit.prim_index.numpy(), 0), weights, np.where(valid, hit.t.numpy(), np.inf)


def normals_at_vertices(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.array(trimesh.Trimesh(vertices, faces, process=False).vertex_normals)
