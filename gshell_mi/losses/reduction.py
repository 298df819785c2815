"""Means that every loss ends with."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def mean(x) -> mi.Float:
    """Mean over every entry of an array, colour or tensor; 0 if there is none, as of a mesh without faces."""
    flat = dr.ravel(x) if not dr.is_tensor_v(x) else x.array
    if dr.width(flat) == 0:
        return mi.Float(0)
    return dr.mean(flat) if dr.depth_v(flat) == 1 else flat


def mean_where(chosen: mi.Bool, x: mi.Float) -> mi.Float:
    """Mean of the entries that are ``chosen``; 0 if none is.

    >>> import mitsuba as mi
    >>> mean_where(mi.Bool(True, False, True), mi.Float(1, 9, 2))[0]
    1.5
    """
    count = dr.sum(dr.select(chosen, mi.Float(1), 0))
    return dr.sum(dr.select(chosen, x, 0)) / dr.maximum(count, 1)
