"""From the ghost's opacity to an mSDF: where the template is cut open."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..extraction.surface_mesh import SurfaceMesh
from ..fields.smoothing import LatticeDiffusion
from ..lattice import Lattice
from ..topology import vertex_components

#: Logits beyond this say no more than "certain"; ν stays near the scale of a distance in cells.
_CERTAIN = 3.0


def clean_opacity(logits: np.ndarray, vertices: np.ndarray, faces: np.ndarray, min_area: float) -> np.ndarray:
    """Undoes the cuts and the islands that are too small to be meant.

    Args:
        logits: (V,) opacity logits; surface where positive.
        vertices, faces: the template.
        min_area: connected patches of one sign smaller than this fraction of the template's area flip.

    Returns:
        (V,) logits, those of flipped patches negated.
    """
    area = np.zeros(len(vertices))
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face_area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    for corner in range(3):
        np.add.at(area, faces[:, corner], face_area / 3)
    cleaned = logits.copy()
    # Cuts first: an island in a cut that closes is none.
    for flip_closed in (False, True):
        solid = cleaned > 0
        patch = _patches(solid, faces)
        small = np.bincount(patch, area)[patch] < min_area * area.sum()
        flip = small & (solid == flip_closed)
        cleaned[flip] = -cleaned[flip]
    return cleaned


def close_unjustified(logits: np.ndarray, faces: np.ndarray, error: Callable[[np.ndarray], np.ndarray],
                      gain: float) -> np.ndarray:
    """Closes the openings through which the images are not explained better than without them.

    A hull that bulges over a fold, or a highlight, makes the views disagree on a vertex's radiance as a
    cap does, and may open there. But the sheet behind such a hole is farther from the truth than the hull,
    so the images disagree more.

    Args:
        logits: (V,) opacity logits; surface where positive.
        faces: (F, 3) of the template.
        error: maps (V,) opaque or not to the (V,) image error through each vertex.
        gain: an opening stays if the error through it is less than this fraction of the closed one's.

    Returns:
        (V,) logits, those of unjustified openings negated.
    """
    opened = logits <= 0
    if not opened.any():
        return logits
    closed_error, open_error = error(np.ones_like(opened)), error(~opened)
    patch = _patches(opened, faces)
    before, after = (np.bincount(patch, e)[patch] for e in (closed_error, open_error))
    return np.where(opened & (after > gain * before), -logits, logits)


def _patches(label: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) ids of the connected patches of equal label."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    same = label[edges[:, 0]] == label[edges[:, 1]]
    return vertex_components(edges[same], len(label))[1]


def msdf_from_template(logits: np.ndarray, template: SurfaceMesh, lattice: Lattice) -> mi.Float:
    """ν at the lattice vertices such that its interpolation on the template follows ``logits``.

    The scale is about that of a distance: one cell per logit; where the template is far away, 1 cell.
    """
    values = mi.Float(np.clip(logits, -_CERTAIN, _CERTAIN).astype(np.float32))
    msdf, known = splat_to_lattice(values, template, lattice)
    return dr.select(known, msdf, 1) * lattice.spacing


def splat_to_lattice(values: mi.Float, template: SurfaceMesh,
                     lattice: Lattice) -> tuple[mi.Float, mi.Bool]:
    """Turns values at the template's vertices, one or three channels, into a lattice field.

    Each lattice vertex takes the mean of the template vertices on its edges, weighted as they
    interpolate it; its surroundings are extended from there.

    Returns:
        The field, and a mask of the lattice vertices that have a value.
    """
    channels = dr.width(values) // template.vertex_count
    total = dr.zeros(mi.Float, channels * lattice.vertex_count)
    weight = dr.zeros(mi.Float, lattice.vertex_count)
    with dr.suspend_grad():
        for vertex, end, share in dr.detach(template.stencil.entries()):
            dr.scatter_reduce(dr.ReduceOp.Add, weight, share, end)
            for channel in range(channels):
                value = dr.gather(mi.Float, values, channels * vertex + channel)
                dr.scatter_reduce(dr.ReduceOp.Add, total, share * value, channels * end + channel)
    return LatticeDiffusion(lattice).extend(total, weight)
