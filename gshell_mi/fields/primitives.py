"""Fields of simple shapes, to start from."""

from dataclasses import replace

import numpy as np

from ..errors import UserError
from ..lattice import BlockLattice, Lattice
from .lattice_fields import LatticeFields


def sphere(lattice: Lattice, radius: float = 0.5, *, in_blocks: bool = False) -> LatticeFields:
    """A sphere about the origin, with the mSDF positive everywhere: the whole template is the surface.

    Args:
        radius: in lattice units, between 0 and 1.
        in_blocks: only the blocks around the surface, see ``BlockLattice``; needs a Mitsuba variant.

    >>> from gshell_mi.lattice import TetLattice
    >>> fields = sphere(TetLattice(4), radius=0.5)
    >>> float(fields.sdf.min()), bool((fields.msdf > 0).all())
    (-0.5, True)
    """
    if not 0 < radius < 1:
        raise UserError(f"the radius of the initial sphere must lie between 0 and 1, not be {radius}")
    if in_blocks:
        import drjit as dr
        import mitsuba as mi

        blocks = BlockLattice.around(lattice, lambda p: dr.norm(p) - radius, mi.Float)
        closed = LatticeFields.closed((dr.norm(blocks.points(mi.Float)) - radius).numpy(), lattice.grid)
        return replace(closed, blocks=blocks.blocks.numpy(), block_resolution=lattice.resolution)
    sdf = np.linalg.norm(lattice.vertex_positions(), axis=1) - radius
    return LatticeFields.closed(sdf, lattice.grid)
