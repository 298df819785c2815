"""Single derivatives that no step may follow."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Derivatives from this size on have overflowed, or their squares are about to.
_OVERFLOWN = 1e12

#: What is far out shifts the mean, too; each pass is without most of what the one before has clipped.
_PASSES = 4


def finite(value: mi.Float) -> mi.Float:
    """The values, 0 in place of those that are NaN or infinite."""
    return dr.select(dr.isfinite(value), value, 0)


def trusted(gradient: mi.Float, most: float = 30.0) -> mi.Float:
    """Derivatives of which none is larger than ``most`` times the mean size of those that are not 0.

    Slivers make derivatives overflow, or nearly; they count as 0 then. And where a derivative is that of a
    ratio, such as of a crossing between two values near 0, or of a hit of a triangle seen from its edge, one
    sample may outweigh the whole surface. Adam with one step size for all goes by the largest derivative and
    remembers it for a hundred to a thousand steps, so one such vertex would hold up all others.

    >>> gradient = dr.ones(mi.Float, 1000)
    >>> gradient[7], gradient[8] = -1e5, dr.nan
    >>> print(dr.min(trusted(gradient)) > -200, trusted(gradient)[8], trusted(gradient)[0])
    [True] 0.0 1.0
    >>> gradient[7], gradient[8] = -1e8, 3e38
    >>> print(dr.min(trusted(gradient)) > -200, trusted(gradient)[8])
    [True] 0.0
    """
    gradient = dr.select(dr.abs(gradient) < _OVERFLOWN, gradient, 0)
    for _ in range(_PASSES):
        size = dr.abs(gradient)
        largest = most * dr.sum(size) / dr.maximum(dr.count(size > 0), 1)
        gradient = dr.clip(gradient, -largest, largest)
    return gradient
