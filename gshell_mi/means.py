"""Means whose kernels serve arrays of every size.

``dr.mean`` makes the number of entries part of its kernel, even for the mean of a colour's channels. Meshes
have other numbers of vertices and edges in every step, and so every step would compile kernels of its own.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .arrays import AnyArray


def mean(x: AnyArray) -> mi.Float:
    """Mean over every entry of an array, colour or tensor; 0 if there is none, as of a mesh without faces."""
    flat = dr.ravel(x) if not dr.is_tensor_v(x) else x.array
    count = dr.width(flat)
    return dr.sum(flat) / dr.opaque(mi.Float, count) if count else mi.Float(0)


def mean_where(chosen: mi.Bool, x: mi.Float) -> mi.Float:
    """Mean of the entries that are ``chosen``; 0 if none is.

    >>> import mitsuba as mi
    >>> mean_where(mi.Bool(True, False, True), mi.Float(1, 9, 2))[0]
    1.5
    """
    count = dr.sum(dr.select(chosen, mi.Float(1), 0))
    return dr.sum(dr.select(chosen, x, 0)) / dr.maximum(count, 1)


def channel_mean(color: mi.Color3f) -> mi.Float:
    """Mean of the channels, one per lane.

    >>> import mitsuba as mi
    >>> channel_mean(mi.Color3f(1, 2, 6))[0]
    3.0
    """
    return dr.sum(color) / len(color)
