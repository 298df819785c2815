"""Lattice fields of a template whose vertices have moved, thick enough for the lattice everywhere.

The refinement pulls both sides of a sheet to where the sheet is. Such a template is thinner than a lattice
cell: sampled at the lattice's vertices it would be frayed and full of holes. But only one side of a sheet is
surface. So the open side is moved away until the lattice can tell both apart.
"""

from __future__ import annotations

import dataclasses

import mitsuba as mi
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from ..compat import mesh_scene
from ..conversion.solid_distance import solid_distance
from ..fields import LatticeFields
from ..fields.smoothing import MeshDiffusion
from ..topology import Topology, topology
from .opening import clean_opacity, msdf_from_template, splat_to_lattice, without_specks

#: The lattice holds what is this thick, in cells, whatever its direction ...
_THICKNESS = 1.2

#: ... but where both sides are surface, moving them apart costs accuracy, and little of this is missed.
_SOLID_THICKNESS = 0.9

#: Values come from where the ray along the normal meets the moved template, at most this many cells away.
_REACH = 1.5

#: Logits of thin parts are limited to this.
_CERTAIN = 1.0

#: Lambda that smooths along the template how far its sides are moved apart.
_SMOOTHING = 2.0

#: Parts of the movement that are tried until one does not tear the surface.
_FRACTIONS = (1.0, 0.7, 0.4)


def recast(subject: mi.Shape, vertices: np.ndarray, moved: np.ndarray, faces: np.ndarray, logits: np.ndarray,
           radiance: np.ndarray, min_area: float) -> dict[str, np.ndarray] | None:
    """Fields whose surface is the moved template's, with the openings that it had.

    Args:
        subject: the gshell shape with the fields before; it is left with others.
        vertices, moved: (V, 3) world positions of the template's vertices before and after.
        faces: (F, 3) of the template.
        logits: (V,) surface where positive, open elsewhere.
        radiance: (V, 3).
        min_area: smaller cuts and islands, as a fraction of the template's area, are undone.

    Returns:
        ``sdf``, ``msdf``, ``radiance`` (n, 3) and ``known`` (n,) on the lattice; None if the surface
        comes out with other boundary loops, or more components or pin-holes, however little it moves.
    """
    before = _counts(subject)
    for fraction in _FRACTIONS:
        fields = _fields(subject, vertices + fraction * (moved - vertices), faces, logits, radiance, min_area)
        if fields is None:
            continue
        closed = LatticeFields.closed(fields["sdf"], subject.lattice.grid)
        subject.set_fields(dataclasses.replace(closed, msdf=fields["msdf"]))
        after = _counts(subject)
        if (after.boundary_loops == before.boundary_loops and after.components <= before.components
                and after.pinholes <= before.pinholes):
            return fields
    return None


def _fields(subject: mi.Shape, vertices: np.ndarray, faces: np.ndarray, logits: np.ndarray,
            radiance: np.ndarray, min_area: float) -> dict[str, np.ndarray] | None:
    lattice, solid = subject.lattice, logits > 0
    to_lattice = np.linalg.inv(np.array(subject.to_world.matrix, np.float64))
    local = vertices @ to_lattice[:3, :3].T + to_lattice[:3, 3]
    # A reflection turns the template inside out.
    local_faces = faces[:, ::-1] if np.linalg.det(to_lattice[:3, :3]) < 0 else faces
    local = thickened(local, local_faces, solid, lattice.spacing)
    sdf = solid_distance(local, local_faces, solid, lattice)
    subject.set_fields(LatticeFields.closed(sdf, lattice.grid))
    template = subject.template()
    if template.is_empty:
        return None
    new_vertices, new_faces, _ = template.to_numpy()
    placed = new_vertices @ to_lattice[:3, :3].T + to_lattice[:3, 3]
    values = _values_on(local, local_faces, np.column_stack([logits, radiance]), placed,
                        _REACH * lattice.spacing)
    # A very sure side must not outvote the other one at the lattice's vertices between them.
    limited = np.clip(values[:, 0], -_CERTAIN, _CERTAIN)
    msdf = msdf_from_template(clean_opacity(limited, new_vertices, new_faces, min_area), template, lattice)
    msdf = without_specks(msdf, template, lattice, min_area)
    colour = mi.Float(np.ascontiguousarray(values[:, 1:], np.float32).ravel())
    radiance, known = splat_to_lattice(colour, template, lattice)
    return {"sdf": sdf, "msdf": msdf.numpy(),
            "radiance": radiance.numpy().reshape(-1, 3), "known": known.numpy()}


def thickened(vertices: np.ndarray, faces: np.ndarray, solid: np.ndarray, cell: float) -> np.ndarray:
    """Moves the sides of thin parts apart: the open side if there is one, otherwise both by half.

    Args:
        vertices: (V, 3) positions.
        faces: (F, 3) of the watertight template, oriented outwards.
        solid: (V,) False where the template is open.
        cell: side of a lattice cell, in the positions' unit.

    Returns:
        (V, 3) positions.
    """
    normals = _normals(vertices, faces)
    thickness, other = _opposite(vertices, faces, normals, solid, cell)
    share = np.where(solid, np.where(other, 0.5, 0.0), np.where(other, 1.0, 0.5))
    wanted = np.where(solid & other, _SOLID_THICKNESS, _THICKNESS)
    growth = np.clip(wanted * cell - thickness, 0, None) * share
    growth = MeshDiffusion(faces, len(vertices), _SMOOTHING)(mi.Float(growth.astype(np.float32))).numpy()
    # Smoothing must not move the side that counts.
    growth[solid & ~other] = 0
    return vertices + growth[:, None] * normals


def _opposite(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, solid: np.ndarray,
              cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Thickness of the template under each vertex, and whether the other side is solid."""
    offset = 1e-3 * cell
    face, weights, distance = _cast(vertices, faces, vertices - offset * normals, -normals, 2 * cell)
    other = np.einsum("ni,ni->n", weights, solid[faces[face]]) > 0.5
    return distance + offset, other


def _values_on(vertices: np.ndarray, faces: np.ndarray, values: np.ndarray, points: np.ndarray,
               reach: float) -> np.ndarray:
    """(n, k) values at ``points``, which lie on a copy of the mesh or near it, from (V, k) at its vertices.

    The nearest hit along the normal counts, which is no hit on the other side of a thin part; points that
    have none take the nearest vertex's value.
    """
    tree = cKDTree(vertices)
    nearest = tree.query(points)[1]
    normals = _normals(vertices, faces)[nearest]
    result, best = values[nearest], np.full(len(points), np.inf)
    # A ray that starts on the mesh would miss it.
    behind = 0.05 * reach
    for direction in (normals, -normals):
        face, weights, distance = _cast(vertices, faces, points - behind * direction, direction, reach)
        distance = np.abs(distance - behind)
        closer = distance < best
        best = np.minimum(best, distance)
        result[closer] = np.einsum("ni,nik->nk", weights[closer], values[faces[face[closer]]])
    return result


def _cast(vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray,
          reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Face, barycentric weights (0 without a hit) and distance (infinite then) of rays on a mesh."""
    o, d = (np.ascontiguousarray(x.T, np.float32) for x in (origins, directions))
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d), reach, 0, [])
    hit = mesh_scene(vertices, faces).ray_intersect_preliminary(ray, coherent=False)
    valid, uv = hit.is_valid().numpy(), hit.prim_uv.numpy().T
    weights = np.where(valid[:, None], np.column_stack([1 - uv.sum(axis=1), uv]), 0)
    return np.where(valid, hit.prim_index.numpy(), 0), weights, np.where(valid, hit.t.numpy(), np.inf)


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.array(trimesh.Trimesh(vertices, faces, process=False).vertex_normals)


def _counts(subject: mi.Shape) -> Topology:
    vertices, faces, _ = subject.surface.to_numpy()
    return topology(vertices, faces)
