"""Lattice fields that follow a template whose vertices were moved."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..lattice import Lattice
from .interpolation import Interpolation

#: Iterations that invert the displacement; each shrinks the error by the displacement's slope.
_INVERSIONS = 8


def advect(field: mi.Float, displacement: mi.Float, lattice: Lattice) -> mi.Float:
    """Carries a lattice field along a displacement (semi-Lagrangian: each vertex looks where it came from).

    Args:
        field: one value, or several interleaved channels, per lattice vertex.
        displacement: (3 n,) how far the material that was at each lattice vertex moved, lattice units.
        lattice: the lattice of both.

    Returns:
        The field afterwards, interpolated trilinearly.
    """
    values, offsets = Interpolation(field, lattice), Interpolation(displacement, lattice)
    points = mi.Point3f(lattice.points(mi.Float))
    source = points
    for _ in range(_INVERSIONS):
        source = points - mi.Vector3f(*offsets.channels(source))
        dr.eval(source)
    return values(source)
