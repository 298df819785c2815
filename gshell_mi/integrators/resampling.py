"""Systematic sampling of long lists, and low-discrepancy numbers along them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Fractional parts of the powers of 1/x with x^8 = x + 1, the root that gives Kronecker sequences of low
#: discrepancy in seven dimensions (Roberts 2018, after Kuipers & Niederreiter 1974), times 2^32.
_STEPS = tuple(int(2**32 * 1.0969815577985598**-k) for k in range(1, 8))


def low_discrepancy(index: mi.UInt32, dimension: int, shifts: mi.Float) -> mi.Float:
    """Numbers in [0, 1): entry ``index`` of a shifted Kronecker sequence.

    Args:
        index: ``UInt32``.
        dimension: 0 to 6.
        shifts: ``Float``, width 7 or more: uniform random numbers, one per dimension.
    """
    shift = dr.gather(mi.Float, shifts, mi.UInt32(dimension))
    x = mi.Float((index * mi.UInt32(_STEPS[dimension])) >> 8) * (1 / 2**24) + shift
    return dr.minimum(x - dr.floor(x), dr.one_minus_epsilon(mi.Float))


def expand(count: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, int]:
    """For counts per item, the item of each of the ``sum(count)`` entries and its number there.

    >>> item, number, total = expand(mi.UInt32(0, 2, 1))
    >>> item.numpy().tolist(), number.numpy().tolist(), total
    ([1, 1, 2], [0, 1, 0], 3)
    """
    item = dr.compress(count > 0)
    if dr.width(item) == 0:
        return item, item, 0
    count = dr.gather(mi.UInt32, count, item)
    first = dr.prefix_sum(count)
    total = dr.sum(count)[0]
    mark = dr.zeros(mi.UInt32, total)
    dr.scatter(mark, mi.UInt32(1), first, mode=dr.ReduceMode.Permute)
    run = dr.cumsum(mark) - 1
    entry = dr.gather(mi.UInt32, item, run)
    number = dr.arange(mi.UInt32, total) - dr.gather(mi.UInt32, first, run)
    dr.eval(entry, number)
    return entry, number, total


def systematic_counts(
    importance: mi.Float, samples: int, offset: mi.Float
) -> tuple[mi.UInt32, mi.Float] | None:
    """How often to draw each item, in proportion to its importance, with one uniform number for all.

    Args:
        importance: ``Float``: not negative; infinite and undefined entries count as 0.
        samples: how many to draw.
        offset: ``Float``, width 1: uniform in [0, 1).

    Returns:
        ``UInt32`` counts, and ``Float``: the weight of one draw of each item, which is one over the
        expected count. ``None`` if nothing has any importance.

    >>> count, weight = systematic_counts(mi.Float(1, 0, 3), 8, mi.Float(0.5))
    >>> count.numpy().tolist(), [round(w, 4) for w in dr.select(count > 0, weight, 0).numpy().tolist()]
    ([2, 0, 6], [0.5, 0.0, 0.1667])
    """
    importance = dr.select(dr.isfinite(importance) & (importance > 0), importance, 0)
    dr.make_opaque(importance)
    cumulative = dr.cumsum(mi.Float64(importance))
    last = dr.opaque(mi.UInt32, dr.width(cumulative) - 1)
    mass = dr.gather(mi.Float64, cumulative, last)
    if not mass[0] > 0:
        return None
    samples = dr.opaque(mi.Float64, samples)
    upper = mi.UInt32(dr.floor(dr.minimum(cumulative / mass, 1) * samples + mi.Float64(offset)))
    dr.eval(upper)
    index = dr.arange(mi.UInt32, dr.width(upper))
    lower = dr.gather(mi.UInt32, upper, index - 1, index > 0)
    count = dr.select(importance > 0, upper - lower, 0)
    weight = mi.Float(mass / samples) / importance
    dr.eval(count, weight)
    return count, weight
