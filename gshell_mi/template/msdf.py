"""From an opacity to an mSDF: where the template is cut open."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..extraction.surface_mesh import SurfaceMesh
from ..fields.smoothing import LatticeDiffusion, MeshDiffusion
from ..lattice import BlockLattice, Lattice
from ..topology import equal_patches, mesh_components
from ..triangles import vertex_areas

#: Logits beyond this say no more than "certain"; ν stays near the scale of a distance in cells.
CERTAIN = 3.0

#: What a speck leaves at its neighbours when it goes may be the next one.
_CLEANINGS = 4

#: Share of a piece of the template that is more than a speck on it: about one of its two sides.
_SIDE = 0.25

#: Lambda that smooths new rims along the template.
_RIMS = 3.0

#: Share of newly open vertices around a vertex from which on its value is new.
_NEAR = 0.01


def clean_opacity(logits: np.ndarray, vertices: np.ndarray, faces: np.ndarray, min_area: float) -> np.ndarray:
    """Undoes the cuts and the islands that are too small to be meant.

    Args:
        logits: (V,) opacity logits; surface where positive.
        vertices, faces: the template.
        min_area: connected patches of one sign flip: cuts smaller than this fraction of the template's area,
            and islands smaller than this fraction of the surface's, which for a sheet is half of that. A side
            of a piece that is apart from the rest counts as the whole piece.

    Returns:
        (V,) logits, those of flipped patches negated.
    """
    area = vertex_areas(vertices, faces)
    cleaned = logits.copy()
    piece = mesh_components(faces, len(vertices))
    piece_area = np.bincount(piece, area)[piece]
    # Cuts first: an island in a cut that closes is none.
    for flip_closed in (False, True):
        solid = cleaned > 0
        patch = equal_patches(solid, faces)
        patch_area = np.bincount(patch, area)[patch]
        patch_area = np.where(patch_area > _SIDE * piece_area, piece_area, patch_area)
        whole = area[solid].sum() if flip_closed else area.sum()
        small = patch_area < min_area * whole
        flip = small & (solid == flip_closed)
        cleaned[flip] = -cleaned[flip]
    return cleaned


def rim_diffusion(faces: np.ndarray, vertex_count: int) -> MeshDiffusion:
    """What smooths new rims of a template with (F, 3) faces."""
    return MeshDiffusion(faces, vertex_count, _RIMS)


def reopened(
    values: np.ndarray, opened: np.ndarray, smooth: MeshDiffusion, scale: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Gives a template other openings, with smooth rims where they differ.

    Args:
        values: (V,) negative where the template is open.
        opened: (V,) where it shall be.
        smooth: along the template.
        scale: of the new values; in [-scale, scale].

    Returns:
        (V,) values, and which of them are new.
    """
    signs = smooth(mi.Float(np.where(opened, -1, 1).astype(np.float32))).numpy()
    near = smooth(mi.Float((opened != (values <= 0)).astype(np.float32))).numpy() > _NEAR
    return np.where(near, scale * signs, values), near


def msdf_from_template(
    logits: np.ndarray, template: SurfaceMesh, lattice: Lattice | BlockLattice
) -> mi.Float:
    """ν at the lattice vertices such that its interpolation on the template follows ``logits``.

    The scale is about that of a distance: one cell per logit; where the template is far away, 1 cell.
    """
    values = mi.Float(np.clip(logits, -CERTAIN, CERTAIN).astype(np.float32))
    msdf, known = splat_to_lattice(values, template, lattice)
    return dr.select(known, msdf, 1) * lattice.spacing


def splat_to_lattice(
    values: mi.Float, template: SurfaceMesh, lattice: Lattice | BlockLattice
) -> tuple[mi.Float, mi.Bool]:
    """Turns values at the template's vertices, one or three channels, into a lattice field.

    Each lattice vertex takes the mean of the template vertices on its edges, weighted as they
    interpolate it; its surroundings are extended from there.

    Args:
        values: one value or three interleaved channels per vertex of the template.
        template: a surface with its stencil.
        lattice: what it was extracted from.

    Returns:
        The field, and a mask of the lattice vertices that have a value.
    """
    total, weight = _splat(values, template, lattice, dr.full(mi.Bool, True, template.vertex_count))
    return LatticeDiffusion(lattice).extend(total, weight)


def without_specks(
    msdf: mi.Float, template: SurfaceMesh, lattice: Lattice | BlockLattice, min_area: float
) -> mi.Float:
    """ν without the cuts and the islands that are too small to be meant, see ``clean_opacity``."""
    vertices, faces, _ = template.to_numpy()
    msdf = dr.detach(msdf)
    for _ in range(_CLEANINGS):
        values = template.interpolate(msdf).numpy()
        cleaned = clean_opacity(values, vertices, faces, min_area)
        if (cleaned == values).all():
            break
        msdf = rewritten(msdf, cleaned, cleaned != values, template, lattice)
    return msdf


def rewritten(
    msdf: mi.Float,
    values: np.ndarray,
    changed: np.ndarray,
    template: SurfaceMesh,
    lattice: Lattice | BlockLattice,
) -> mi.Float:
    """ν with new values at the template's vertices that have changed.

    Only these are written: on its way over the mesh and back a field loses its details.
    """
    total, weight = _splat(mi.Float(values.astype(np.float32)), template, lattice, mi.Bool(changed))
    return dr.select(weight > 0, total / dr.maximum(weight, 1e-12), msdf)


def _splat(
    values: mi.Float, template: SurfaceMesh, lattice: Lattice | BlockLattice, counted: mi.Bool
) -> tuple[mi.Float, mi.Float]:
    """Sums, over the counted vertices of the template, of weighted values and of weights."""
    channels = dr.width(values) // template.vertex_count
    total = dr.zeros(mi.Float, channels * lattice.vertex_count)
    weight = dr.zeros(mi.Float, lattice.vertex_count)
    assert template.stencil is not None, "it is extracted"
    with dr.suspend_grad():
        for vertex, end, share in dr.detach(template.stencil.entries()):
            share = dr.select(dr.gather(mi.Bool, counted, vertex), share, 0)
            dr.scatter_reduce(dr.ReduceOp.Add, weight, share, end)
            for channel in range(channels):
                value = dr.gather(mi.Float, values, channels * vertex + channel)
                dr.scatter_reduce(dr.ReduceOp.Add, total, share * value, channels * end + channel)
    return total, weight
