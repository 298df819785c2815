"""Reading the value of a loss."""

import drjit as dr
import mitsuba as mi


def value(loss) -> float:
    """The one number that every loss is."""
    assert type(loss) is mi.Float and dr.width(loss) == 1
    return loss[0]
