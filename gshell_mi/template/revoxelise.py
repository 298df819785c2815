"""Lattice fields of a template whose vertices have moved, thick enough for the lattice everywhere.

The refinement pulls both sides of a sheet to where the sheet is. Such a template is thinner than a lattice
cell: sampled at the lattice's vertices it would be frayed and full of holes. But only one side of a sheet is
surface. So the open side is moved away until the lattice can tell both apart.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from ..conversion.solid_distance import solid_distance
from ..fields import LatticeFields
from ..fields.smoothing import MeshDiffusion
from ..lattice import Lattice
from ..topology import PINHOLE, Topology, boundary_edges, topology
from ..triangles import positive_part
from .msdf import clean_opacity, msdf_from_template, splat_to_lattice, without_specks
from .sides import normals_at_vertices, opposite_sides
from .values_nearby import values_nearby

#: The lattice holds what is this thick, in cells, whatever its direction ...
HELD = 1.2

#: ... and of a sheet, whose open side may be anywhere, there is no reason to be sparing ...
_SLAB = 1.8

#: ... but where both sides are surface, moving them apart costs accuracy, and little of this is missed.
_SOLID_THICKNESS = 0.9

#: Values come from where the ray along the normal meets the moved template, at most this many cells away.
_REACH = 1.5

#: Logits of thin parts are limited to this.
_CERTAIN = 1.0

#: Lambda that smooths along the template how far its sides are moved apart.
_SMOOTHING = 2.0

#: What smoothing takes from the movement is made up for in further passes.
_PASSES = 3

#: So many pin-holes are let pass where no part of the movement goes without: the joint stage may shut them.
_PINHOLES = 3

#: A boundary belongs to a rim of the template if half of it is at most this many cells from one. The rim lies
#: between the side that stays and the one that is moved away.
_RIM = 2.0

#: Parts of the movement that are tried until one does not tear the surface.
_FRACTIONS = (1.0, 0.7, 0.4)


@dataclass(frozen=True)
class Revoxelised:
    """Fields of a template that has moved.

    Attributes:
        fields: ``sdf``, ``msdf``, ``radiance`` (n, 3) and ``known`` (n,) on the lattice.
        has_loops: whether their surface has as many boundary loops as were asked for.
    """

    fields: dict[str, np.ndarray]
    has_loops: bool


def revoxelise(
    subject: mi.Shape,
    lattice: Lattice,
    vertices: np.ndarray,
    moved: np.ndarray,
    faces: np.ndarray,
    logits: np.ndarray,
    radiance: np.ndarray,
    min_area: float,
    wanted: Topology,
    fewest_loops: int | None = None,
) -> Revoxelised | None:
    """Fields whose surface is the moved template's, with its openings.

    Parts of the movement are tried until one leaves all boundary loops.

    Args:
        subject: the gshell shape, whose place the fields are in.
        lattice: of the fields.
        vertices, moved: (V, 3) world positions of the template's vertices before and after.
        faces: (F, 3) of the template.
        logits: (V,) surface where positive, open elsewhere.
        radiance: (V, 3).
        min_area: cuts and islands that are undone, as of ``clean_opacity``.
        wanted: what the surface is to be like. Where rims meet that have moved, a bridge closes and it has
            more boundary loops.
        fewest_loops: so few boundary loops will do; by default as many as are wanted.

    Returns:
        The fields, of the whole movement if no part of it leaves all boundary loops; None if the surface
        comes out torn, with more components or many more pin-holes, however little it moves.
    """
    nearly, closed_up = None, None
    fewest_loops = wanted.boundary_loops if fewest_loops is None else fewest_loops
    for fraction in _FRACTIONS:
        placed = vertices + fraction * (moved - vertices)
        fields = _fields(subject, lattice, vertices, placed, faces, logits, radiance, min_area)
        if fields is None:
            continue
        closed = LatticeFields.closed(fields["sdf"], lattice.grid)
        surface = subject.surface_of(dataclasses.replace(closed, msdf=fields["msdf"]))
        surface_vertices, surface_faces, _ = surface.to_numpy()
        found = topology(surface_vertices, surface_faces)
        torn = is_torn(
            surface_vertices,
            surface_faces,
            *positive_part(placed, faces, logits),
            _RIM * lattice.spacing * subject.length_scale,
        )
        if torn or found.components > wanted.components or found.pinholes > wanted.pinholes + _PINHOLES:
            continue
        if found.boundary_loops < fewest_loops:
            closed_up = closed_up or Revoxelised(fields, has_loops=False)
        elif found.pinholes <= wanted.pinholes:
            return Revoxelised(fields, has_loops=True)
        else:
            nearly = nearly or Revoxelised(fields, has_loops=True)
    return nearly or closed_up


def _fields(
    subject: mi.Shape,
    lattice: Lattice,
    vertices: np.ndarray,
    moved: np.ndarray,
    faces: np.ndarray,
    logits: np.ndarray,
    radiance: np.ndarray,
    min_area: float,
) -> dict[str, np.ndarray] | None:
    solid = logits > 0
    to_lattice = np.linalg.inv(np.array(subject.to_world.matrix, np.float64))
    before, local = (points @ to_lattice[:3, :3].T + to_lattice[:3, 3] for points in (vertices, moved))
    # A reflection turns the template inside out.
    local_faces = faces[:, ::-1] if np.linalg.det(to_lattice[:3, :3]) < 0 else faces
    local = thickened(before, local, local_faces, solid, lattice.spacing)
    sdf = solid_distance(local, local_faces, solid, lattice)
    template = subject.surface_of(LatticeFields.closed(sdf, lattice.grid), template=True)
    if template.is_empty:
        return None
    new_vertices, new_faces, _ = template.to_numpy()
    placed = new_vertices @ to_lattice[:3, :3].T + to_lattice[:3, 3]
    placed_faces = new_faces if local_faces is faces else new_faces[:, ::-1]
    values = values_nearby(
        local,
        local_faces,
        np.column_stack([logits, radiance]),
        placed,
        placed_faces,
        _REACH * lattice.spacing,
    )
    # A very sure side must not outvote the other one at the lattice's vertices between them.
    limited = np.clip(values[:, 0], -_CERTAIN, _CERTAIN)
    msdf = msdf_from_template(clean_opacity(limited, new_vertices, new_faces, min_area), template, lattice)
    msdf = without_specks(msdf, template, lattice, min_area)
    colour = mi.Float(np.ascontiguousarray(values[:, 1:], np.float32).ravel())
    seen, known = splat_to_lattice(colour, template, lattice)
    return {"sdf": sdf, "msdf": msdf.numpy(), "radiance": seen.numpy().reshape(-1, 3), "known": known.numpy()}


def is_torn(
    vertices: np.ndarray, faces: np.ndarray, cut_vertices: np.ndarray, cut_faces: np.ndarray, near: float
) -> bool:
    """Whether a surface has a boundary, pin-holes aside, where the cut template that it is to be has none."""
    boundary, loop = boundary_edges(faces)
    if len(boundary) == 0:
        return False
    start, end = vertices[boundary].transpose(1, 0, 2)
    length, middle = np.linalg.norm(end - start, axis=1), (start + end) / 2
    rim = cut_vertices[boundary_edges(cut_faces)[0]].mean(axis=1)
    far = np.ones(len(boundary), bool)
    if len(rim):
        far = cKDTree(rim).query(middle)[0] > near
    whole = np.bincount(loop, length)
    diagonal = np.linalg.norm(np.ptp(vertices[np.unique(faces)], axis=0))
    return bool(((np.bincount(loop, length * far) > 0.5 * whole) & (whole > PINHOLE * diagonal)).any())


def thickened(
    before: np.ndarray, moved: np.ndarray, faces: np.ndarray, solid: np.ndarray, cell: float
) -> np.ndarray:
    """Moves the sides of thin parts apart: the open side if there is one, otherwise both by half.

    Args:
        before, moved: (V, 3) positions. Sides may have moved through each other.
        faces: (F, 3) of the watertight template, oriented outwards.
        solid: (V,) False where the template is open.
        cell: side of a lattice cell, in the positions' unit.

    Returns:
        (V, 3) positions.
    """
    smooth = MeshDiffusion(faces, len(moved), _SMOOTHING)
    for _ in range(_PASSES):
        normals = normals_at_vertices(moved, faces)
        thickness, opposite = opposite_sides(before, moved, faces, cell)
        other = np.isfinite(thickness) & solid[opposite]
        share = np.where(solid, np.where(other, 0.5, 0.0), np.where(other, 1.0, 0.5))
        wanted = np.where(solid & other, _SOLID_THICKNESS, np.where(other, _SLAB, HELD))
        growth = np.clip(wanted * cell - thickness, 0, None) * share
        growth = smooth(mi.Float(growth.astype(np.float32))).numpy()
        # Smoothing must not move the side that counts.
        growth[solid & ~other] = 0
        moved = moved + growth[:, None] * normals
    return moved
