"""The narrow band: where to look for a surface that moves a little from one extraction to the next."""

from typing import Any

import drjit as dr

from ..errors import UserError
from ..lattice import Lattice

_BLOCK = (32, 4, 4)  # cells per block along x, y, z; the scan reads 32 neighbours along x at once


class NarrowBand:
    """Blocks of cells around the surface of the last extraction, handed to ``extract`` time and again.

    The band holds the blocks of 32 x 4 x 4 cells within 4 cells of the surface. The next extraction looks
    nowhere else, so that its cost follows the area of the surface. While the surface moves by less than
    4 cells between two extractions the result is that without a band, bit by bit. A piece of surface that
    appears away from the band is found when the whole lattice is scanned again. Values that are not finite
    are noticed where the surface passes, and at the next scan elsewhere.

    Args:
        rescan: extractions from one scan of the whole lattice to the next; 0 for the first one only.

    >>> import drjit.llvm.ad as d
    >>> from gshell_mi.extraction import extract
    >>> from gshell_mi.lattice import TetLattice
    >>> lattice, band = TetLattice(64), NarrowBand(rescan=20)
    >>> for radius in (0.5, 0.52):
    ...     mesh = extract(lattice, dr.norm(lattice.points(d.Float)) - radius, band=band)
    >>> mesh.to_trimesh().is_watertight, round(band.fraction, 2)
    (True, 0.28)
    """

    def __init__(self, rescan: int = 50):
        if rescan < 0:
            raise UserError(f"rescan counts extractions from one scan to the next, and is {rescan}")
        self.rescan = rescan
        self._age = 0
        self._lattice: Lattice | None = None
        self._blocks: Any = None  # per block: 1 if it is in the band

    @property
    def fraction(self) -> float:
        """Share of the lattice's blocks that are in the band; 1 before the first extraction."""
        if self._blocks is None:
            return 1.0
        return dr.sum(self._blocks)[0] / dr.width(self._blocks)

    def is_due(self, lattice: Lattice) -> bool:
        """Whether the next extraction scans the whole lattice."""
        return self._lattice != lattice or (self.rescan > 0 and self._age % self.rescan == 0)

    def words(self, uint_t: type) -> tuple[Any, Any]:
        """The words of 32 vertices to look at, and those and their neighbours, which have to be known."""
        lattice = self._lattice
        count = -(-lattice.vertex_count // 32)
        last = dr.opaque(uint_t, count - 1)
        stride = dr.opaque(uint_t, lattice.stride)
        blocks = dr.compress(self._blocks == 1)
        if dr.width(blocks) == 0:
            return blocks, blocks
        nx, ny, _ = _block_counts(lattice)
        lane = dr.arange(uint_t, dr.width(blocks) * _BLOCK[1] * _BLOCK[2])
        block, row = dr.gather(uint_t, blocks, lane // 16), lane & 15
        across = dr.opaque(uint_t, nx)
        above = dr.opaque(uint_t, ny)
        x = block % across * 32
        y = block // across % above * 4 + (row & 3)
        z = block // (across * above) * 4 + (row >> 2)
        exists = (y < stride) & (z < stride)
        first = (x + stride * (y + stride * z)) >> 5  # 32 vertices lie in two words
        look = dr.zeros(uint_t, count)
        for word in (first, first + 1):
            dr.scatter(look, uint_t(1), dr.minimum(word, last), exists)
        look = dr.compress(look == 1)
        needed = dr.zeros(uint_t, count)
        for corner in range(8):
            offset = ((corner & 1) + (corner >> 1 & 1) * stride + (corner >> 2) * stride * stride) >> 5
            for word in (look + offset, look + offset + 1):
                dr.scatter(needed, uint_t(1), dr.minimum(word, last))
        return look, dr.compress(needed == 1)

    def follow(self, cell: Any, lattice: Lattice) -> None:
        """Makes the blocks of the cells and their neighbours the band."""
        self._age = 1 if self.is_due(lattice) else self._age + 1
        self._lattice = lattice
        uint_t = type(cell)
        counts = _block_counts(lattice)
        blocks = dr.zeros(uint_t, counts[0] * counts[1] * counts[2])
        nx, ny = dr.opaque(uint_t, counts[0]), dr.opaque(uint_t, counts[1])
        if dr.width(cell):
            stride = dr.opaque(uint_t, lattice.stride)
            row = cell // stride
            z = row // stride
            x, y = cell - row * stride, row - z * stride
            rows = nx * ((y >> 2) + ny * (z >> 2))
            # Along x the blocks are long, and their neighbours are seldom near.
            dr.scatter(blocks, uint_t(1), (dr.maximum(x, 4) - 4 >> 5) + rows)
            dr.scatter(blocks, uint_t(1), (dr.minimum(x + 4, stride - 1) >> 5) + rows)
        index = dr.arange(uint_t, dr.width(blocks))
        across = ((nx, index // nx % ny, counts[1]), (nx * ny, index // (nx * ny), counts[2]))
        for step, coordinate, size in across:
            before = dr.gather(uint_t, blocks, index - step, coordinate > 0)
            after = dr.gather(uint_t, blocks, index + step, coordinate + 1 < dr.opaque(uint_t, size))
            blocks = blocks | before | after
            dr.eval(blocks)
        self._blocks = blocks


def _block_counts(lattice: Lattice) -> tuple[int, int, int]:
    return tuple(-(-lattice.stride // side) for side in _BLOCK)
