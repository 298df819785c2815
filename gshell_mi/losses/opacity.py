"""What the opacity of the openings stage should decide."""

from __future__ import annotations

import mitsuba as mi

from ..arrays import AnyArray
from ..means import mean


def binary_entropy_bound(alpha: AnyArray) -> mi.Float:
    """Mean of ``4 a (1 - a)``: 0 where opacity has decided, 1 at one half."""
    return mean(4 * alpha * (1 - alpha))


def transparency(alpha: AnyArray) -> mi.Float:
    """Mean of ``1 - a``: the pressure that closes what the images leave undecided."""
    return mean(1 - alpha)
