"""Lanes that go on where others have nothing left to do."""

from __future__ import annotations

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
