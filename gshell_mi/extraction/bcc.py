"""Marching tetrahedra cut by the mSDF, on a body-centred cubic lattice.

Its tetrahedra are those of a Kuhn lattice squeezed along the diagonal that they share (``BccLattice.BASIS``),
so the tables and the numbering of edges and faces are the same, with half diagonals in place of axes. What
differs is where the corners of a squeezed cell are, and that at the border some of its tetrahedra exist
and others do not.
"""

from functools import cache

import drjit as dr
import numpy as np

from ..arrays import UInt32
from ..lattice import MISSING, BccLattice
from ..lattice.sign_words import is_set
from . import tet_tables as tables
from .grid_extraction import ActiveCells
from .tetrahedra import TetExtraction


class BccExtraction(TetExtraction):
    """Marching tetrahedra between two cubic grids."""

    def corner(self, vertex: UInt32, corner: UInt32) -> UInt32:
        return self.lattice.corner(vertex, corner)

    def classify(self, inside: UInt32, cell: UInt32) -> ActiveCells:
        # A corner that does not exist takes the sign of the cell's own vertex: no edge there is crossed.
        own = is_set(inside, cell)
        signs = dr.select(own, self.uint_t(1), 0)
        lacking = dr.zeros(self.uint_t)
        for corner in range(1, 8):
            vertex = self.corner(cell, self.uint_t(corner))
            exists = vertex != MISSING
            sign = dr.select(exists, is_set(inside, vertex, exists), own)
            signs |= dr.select(sign, self.uint_t(1 << corner), 0)
            lacking |= dr.select(exists, 0, self.uint_t(1 << corner))
        crossed = (signs ^ dr.select(own, self.uint_t(255), 0)) & self.EDGE_DIFFERENCES & ~self._lone(cell)
        dr.eval(signs, crossed, lacking)
        return ActiveCells(inside, cell, signs, crossed, lacking)

    def _lone(self, cell: UInt32) -> UInt32:
        """Bit d: the edge to corner d belongs to no tetrahedron. So it is with the outermost rows of each
        grid on the side where the other grid does not reach beyond it, and with two half diagonals."""
        assert isinstance(self.lattice, BccLattice), "its fields do not fit in blocks"
        x, y, z = self.lattice.coordinates(cell)
        second, last = cell >= self.stride * self.stride * self.stride, self.stride - 1
        end = dr.select(second, last, 0)
        at_x, at_y, at_z = (number == end for number in (x, y, z))
        along_z, along_y, along_x = at_x & at_y, at_x & at_z, at_y & at_z
        in_corner = ~second & ((x + y + z == 0) | (x + y + z == 3 * last))
        bits = ((along_z, 0b011), (along_y, 0b101), (along_x, 0b110), (in_corner, 0b111))
        lone = self.uint_t(0)
        for outermost, corner in bits:
            lone |= dr.select(outermost, self.uint_t(1 << corner), 0)
        return lone

    def active_tets(self, cells: ActiveCells) -> UInt32:
        existing = dr.gather(self.uint_t, self.uint_t(existing_tets_table()), cells.border)
        return existing & dr.gather(self.uint_t, self.uint_t(tables.active_tets_table()), cells.signs)


@cache
def existing_tets_table() -> np.ndarray:
    """``[lacking]``: bit i tells that tetrahedron i has all its corners; ``lacking`` has bit c set if corner
    c of the cell does not exist."""
    return np.array(
        [
            sum(
                1 << tet
                for tet, corners in enumerate(tables.TETS)
                if not any(lacking >> corner & 1 for corner in corners)
            )
            for lacking in range(256)
        ],
        np.uint32,
    )
