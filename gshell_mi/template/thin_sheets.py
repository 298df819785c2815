"""Sides of sheets that a template can do without: where both are surface, one is enough.

A hull has two sides where the object is one sheet. Both sides of a brim are seen, and neither disagrees with
the images. But a lattice holds nothing thinner than a cell, so both would have to stay apart by that much.
Beside an opening, or where the whole object is a sheet, a template that leaves one side out is right, and the
side that stays can be where the sheet is.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..fields.smoothing import MeshDiffusion
from ..topology import Topology, mesh_edges, patch_sizes, spread, topology, vertex_components
from ..triangles import positive_part
from .msdf import clean_opacity, reopened, rim_diffusion
from .sides import normals_at_vertices, opposite_sides
from .small_sheets import small_sheets

#: Parts are thin up to this thickness, in cells.
_THIN = 1.2

#: Least cosine with which sides of a sheet face away from each other, and neighbours on a side the same way.
_FLAT = 0.8

#: Openings smaller than this fraction of the largest grow last, all at once.
_SMALL = 0.05

#: What is cut off and smaller than this fraction of what it was part of goes.
_CUT_OFF = 0.1

#: Where there is no opening, a part is a sheet only if one side of it is this fraction of it.
_SHEET_SHARE = 0.35

#: Size, at least, of the logits of both sides where one stays.
_LEAST = 0.2

#: A ridge is up to twice this many vertices wide.
_RIDGE = 3

#: Rounds of smoothing and balancing.
_BALANCINGS = 10


@dataclass(frozen=True)
class Cut:
    """A template, and how it is to be cut.

    Attributes:
        logits: (V,) surface where positive, open elsewhere.
        positions: (V, 3) of the vertices, world units.
        topology: of what stays.
        fewest_loops: boundary loops of what stays if those close that a hole through a sheet, a tunnel before
            one side went, has got. The hull of a thin sheet may have more holes than the sheet.
    """

    logits: np.ndarray
    positions: np.ndarray
    topology: Topology
    fewest_loops: int


def collapsed_sheets(
    cut: Cut, before: np.ndarray, faces: np.ndarray, cell: float, sheet_thickness: float, min_area: float
) -> Cut | None:
    """A moved template without the sides that it can do without; None if there are none.

    Args:
        cut: the template with them.
        before: (V, 3) positions before it moved, when it was nowhere too thin for the lattice.
        faces: (F, 3) of the watertight template, oriented outwards.
        cell: side of a lattice cell, in the positions' unit.
        sheet_thickness: median thickness, in cells, up to which a part without an opening is a sheet.
        min_area: cuts and islands that are undone, as of ``clean_opacity``.
    """
    solid = cut.logits > 0
    thickness, opposite = opposite_sides(before, cut.positions, faces, cell)
    normals, smooth = normals_at_vertices(before, faces), rim_diffusion(faces, len(solid))
    redundant, sheets = redundant_sides(
        thickness, opposite, normals, faces, solid, smooth, cell, sheet_thickness
    )
    small, count = small_sheets(cut.positions, normals, faces, ~solid | redundant, sheet_thickness * cell)
    redundant, sheets = redundant | small, sheets + count
    if not redundant.any():
        return None
    logits, _ = reopened(cut.logits, ~solid | redundant, smooth)
    logits[redundant] = np.minimum(logits[redundant], -_LEAST)
    stays = solid & ~redundant & np.isfinite(thickness) & (redundant | ~solid)[opposite]
    logits[stays] = np.maximum(logits[stays], _LEAST)
    logits = clean_opacity(logits, before, faces, min_area)
    left = topology(*positive_part(before, faces, logits))
    thickness, opposite = opposite_sides(before, before, faces, cell)
    opposite = np.where(np.isfinite(thickness), opposite, -1)
    return Cut(
        logits,
        carried(before, cut.positions, redundant, opposite, smooth),
        left,
        min(cut.fewest_loops + sheets, left.boundary_loops),
    )


def redundant_sides(
    thickness: np.ndarray,
    opposite: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    solid: np.ndarray,
    smooth: MeshDiffusion,
    cell: float,
    sheet_thickness: float,
) -> tuple[np.ndarray, int]:
    """Sides of thin parts that may go: those beside openings, and one of a part that is nothing but a sheet.

    Args:
        thickness: (V,) of the template under each vertex; infinite where there is no other side.
        opposite: (V,) vertex on the other side.
        normals: (V, 3) of the template before it moved.
        faces: (F, 3) of the template.
        solid: (V,) False where the template is open.
        smooth: along the mesh.
        cell: side of a lattice cell, in the unit of ``thickness``.
        sheet_thickness: median thickness, in cells, up to which a part without an opening is a sheet.

    Returns:
        (V,) whether a vertex may be opened too, and how many parts without an opening are sheets.
    """
    edges, _ = mesh_edges(faces)
    facing_away = np.einsum("nj,nj->n", normals, normals[opposite]) < -_FLAT
    thin = solid & solid[opposite] & (thickness < _THIN * cell) & facing_away
    part = vertex_components(edges, len(solid))[1]
    closed = (np.bincount(part, ~solid) == 0)[part]
    candidates = np.flatnonzero(thin & closed)
    opened = _grown(~solid | closed & _one_side(thin, normals, edges, part), thin, opposite, edges)
    opened |= _cut_off(opened, solid, edges)
    # Where a sheet is narrow its rims are near, and smoothing them must not change what stays between them.
    decided = np.isfinite(thickness) & (opened | opened[opposite])
    redundant = solid & np.where(decided, opened, _balanced(opened, thin, opposite, edges, smooth) < 0)
    # A fin of something solid is no sheet, nor is a plate, whose sides stay apart.
    share = np.bincount(part, redundant) / np.maximum(np.bincount(part, solid), 1)
    sheets = [
        index
        for index in np.unique(part[candidates])
        if share[index] > _SHEET_SHARE
        and np.median(thickness[candidates[part[candidates] == index]]) < sheet_thickness * cell
    ]
    return redundant & (~closed | np.isin(part, sheets)), len(sheets)


def _one_side(thin: np.ndarray, normals: np.ndarray, edges: np.ndarray, part: np.ndarray) -> np.ndarray:
    """(V,) of the thin vertices of each part the largest patch without a ridge."""
    start, end = edges.T
    flat = thin[start] & thin[end] & (np.einsum("nj,nj->n", normals[start], normals[end]) > _FLAT)
    patch = vertex_components(edges[flat], len(thin))[1]
    size, largest = patch_sizes(patch, part, thin)
    # Of patches of one size, the first.
    chosen = np.flatnonzero(thin & (size == largest))
    first = patch[chosen[np.unique(part[chosen], return_index=True)[1]]]
    return thin & np.isin(patch, first)


def _grown(opened: np.ndarray, thin: np.ndarray, opposite: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(V,) openings grown over thin parts, as far as the other side stays, and over the ridges beyond.

    One opening after the other grows, the largest first: small ones, such as along the rim of a hole, would
    take the side that stays away from it.
    """
    patch = vertex_components(edges[opened[edges].all(axis=1)], len(opened))[1]
    sizes = np.bincount(patch, opened)
    needed, start = np.zeros(len(opened), bool), opened
    needed[opposite[opened & thin]] = True
    sources = [patch == index for index in np.argsort(-sizes) if sizes[index] > _SMALL * sizes.max()]
    for source in (*sources, opened):
        while True:
            front = spread(source, edges) & thin & ~opened & ~opened[opposite] & ~needed
            # Of two sides that are reached at once one stays.
            front &= ~(front[opposite] & (opposite < np.arange(len(opened))))
            if not front.any():
                break
            source, opened = source | front, opened | front
            needed[opposite[front]] = True
    # Where a sheet ends its sides meet in a ridge, which has no other side.
    return opened | spread(opened & ~start, edges) & ~needed & ~(thin & opened[opposite])


def _cut_off(opened: np.ndarray, solid: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(V,) small pieces of what was ``solid`` that hang in the opening now."""
    patch = vertex_components(edges[~opened[edges].any(axis=1)], len(solid))[1]
    whole = vertex_components(edges[solid[edges].all(axis=1)], len(solid))[1]
    size, largest = patch_sizes(patch, whole, ~opened)
    return ~opened & (size < _CUT_OFF * largest)


def _balanced(
    opened: np.ndarray, thin: np.ndarray, opposite: np.ndarray, edges: np.ndarray, smooth: MeshDiffusion
) -> np.ndarray:
    """(V,) negative where open: smooth along the mesh, of opposite sign on the two sides of thin parts."""
    signs = np.where(opened, -1.0, 1.0)
    free = thin
    for _ in range(_RIDGE):
        free = spread(free, edges)
    result = signs
    for _ in range(_BALANCINGS):
        result = smooth(mi.Float(result.astype(np.float32))).numpy()
        result = np.where(thin, 0.5 * (result - result[opposite]), result)
        result = np.where(free, result / max(np.abs(result).max(), 1e-6), signs)
    return result


def carried(
    before: np.ndarray, moved: np.ndarray, redundant: np.ndarray, opposite: np.ndarray, smooth: MeshDiffusion
) -> np.ndarray:
    """(V, 3) positions in which redundant sides go where the sides that stay go.

    Alone they would end up in the other side or beyond: nothing keeps what the images hardly tell apart.

    Args:
        before, moved: (V, 3) positions.
        redundant: (V,) vertices that are open now.
        opposite: (V,) vertex on the other side; negative if there is none.
        smooth: spreads values to vertices that have no other side.
    """
    known = ~redundant | (opposite >= 0) & ~redundant[opposite]
    movement = np.where(redundant[:, None], moved[opposite] - before[opposite], moved - before)
    movement[~known] = 0
    columns = [smooth(mi.Float(column.astype(np.float32))).numpy() for column in (known, *movement.T)]
    mean = np.stack(columns[1:], axis=1) / np.maximum(columns[0], 1e-6)[:, None]
    return np.where(redundant[:, None], before + mean, moved)
