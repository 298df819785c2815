"""Fields of simple shapes, to start from."""

import numpy as np

from ..errors import UserError
from ..lattice import Lattice
from .lattice_fields import LatticeFields


def sphere(lattice: Lattice, radius: float = 0.5) -> LatticeFields:
    """A sphere about the origin, with the mSDF positive everywhere: the whole template is the surface.

    Args:
        radius: in lattice units, between 0 and 1.

    >>> from gshell_mi.lattice import TetLattice
    >>> fields = sphere(TetLattice(4), radius=0.5)
    >>> float(fields.sdf.min()), bool((fields.msdf > 0).all())
    (-0.5, True)
    """
    if not 0 < radius < 1:
        raise UserError(f"the radius of the initial sphere must lie between 0 and 1, not be {radius}")
    sdf = np.linalg.norm(lattice.vertex_positions(), axis=1) - radius
    return LatticeFields.closed(sdf, lattice.grid)
