"""Lanes that go on where others have nothing left to do."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import drjit as dr
import mitsuba as mi


def chosen_lanes(chosen: mi.Bool, values) -> mi.UInt32:
    """The lanes that are ``chosen``, in order, to gather ``values`` (any tree of arrays) at.

    All is evaluated in one kernel: what is gathered from is otherwise evaluated one by one, and a ray that it
    depends on is traced each time.

    >>> import mitsuba as mi
    >>> chosen_lanes(mi.Bool(True, False, True), mi.Float(5, 6, 7))
    [0, 2]
    """
    dr.eval(chosen, values)
    return dr.compress(chosen)


def joined_lanes(several: list[Any]) -> Any:
    """The lanes of some trees of arrays, of dataclasses and lists, one after the other.

    >>> import mitsuba as mi
    >>> joined_lanes([[mi.Float(1, 2)], [mi.Float(3)]])
    [[1, 2, 3]]
    """
    first = several[0]
    if is_dataclass(first):
        return type(first)(
            *(joined_lanes([getattr(each, entry.name) for each in several]) for entry in fields(first))
        )
    if isinstance(first, list):
        return [joined_lanes(list(same)) for same in zip(*several, strict=True)]
    if dr.depth_v(first) > 1:
        return type(first)(*(joined_lanes([each[index] for each in several]) for index in range(len(first))))
    return dr.concat(several)
