"""Implicit shapes that bodies of cloth are made of, in Dr.Jit arrays.

All take points and numbers that may be arrays, so that garments of one kind share one kernel.
"""

from __future__ import annotations

import drjit as dr


def smooth_union(a, b, width):
    """The smaller of two distances, blended where they differ by less than ``width``."""
    h = dr.maximum(width - dr.abs(a - b), 0) / width
    return dr.minimum(a, b) - h * h * width / 4


def smooth_cut(a, b, width):
    """The larger of two distances, blended: where both shapes are."""
    return -smooth_union(-a, -b, width)


def smooth_step(x, low, high):
    """0 below ``low``, 1 above ``high``, cubic between."""
    t = dr.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def column(p, radius, depth):
    """Beside the y axis, elliptic: ``radius`` along x and ``depth`` times that along z."""
    return dr.sqrt(dr.square(p.x) + dr.square(p.z / depth)) - radius


def limb(p, start, direction, length, first, last):
    """A round cone that begins at ``start``; also the way along its axis and the distance to that."""
    offset = p - start
    along = dr.dot(offset, direction)
    on_axis = dr.clip(along, 0, length)
    away = dr.norm(offset - on_axis * direction)
    return away - (first + (last - first) * on_axis / length), along, away
