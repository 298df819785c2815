"""The narrow band: the part of a lattice that is stored, in blocks around a surface."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import drjit as dr
import numpy as np
from scipy import ndimage

from ..arrays import Array3f, Bool, Field, Float, UInt32
from ..errors import UserError
from .lattice import MISSING, Lattice
from .sign_scan import active_cells, closed_signs, sign_changes
from .sign_words import is_set, pack_signs, set_bits

#: Cells per block along x, y, z. A row of a block has as many vertices as a machine word has bits.
BLOCK = (32, 4, 4)

#: Cells between a surface and the edge of the blocks around it, at least.
MARGIN = 3

#: Vertices of the whole lattice at which a function is evaluated at a time.
_SLAB = 1 << 22


class BlockLattice:
    """The vertices of some blocks of a lattice, used in place of the lattice: memory follows the surface.

    A block has 32 x 4 x 4 cells and owns their lowest vertices. Fields on a ``BlockLattice`` have one value
    per *stored* vertex, and so have their gradients and what an optimiser keeps for them: about n^2 values
    instead of n^3. ``extract``, ``LatticeDiffusion`` and the ``gshell`` shape take it like a lattice.

    Stored vertices come in rows of 32 along x and ascend as in the lattice, so the mesh of a surface that
    stays inside is that of the whole lattice, bit by bit and in the same order. Vertices at the edge of the
    blocks keep the sign that they had when the blocks were formed, whatever happens to their values: so the
    surface never runs out of the blocks, and the promises of ``extract`` hold.

    Args:
        lattice: the whole lattice.
        blocks: ids of the stored blocks, Dr.Jit ``UInt32``, ascending and unique; block (x, y, z) is number
            ``x + nx (y + ny z)`` with nx = stride / 32 and ny = stride / 4 rounded up.
        sdf: returns the signed distance at the stored vertices of the ``BlockLattice`` that it is given; its
            signs at the edge are those that are kept.

    Raises:
        UserError: the surface of ``sdf`` runs out of the blocks.

    >>> import drjit as dr, drjit.llvm.ad as d
    >>> from gshell_mi.extraction import extract
    >>> from gshell_mi.lattice import TetLattice
    >>> blocks = BlockLattice.around(TetLattice(128), lambda p: dr.norm(p) - 0.5, d.Float)
    >>> sdf = dr.norm(blocks.points(d.Float)) - 0.5
    >>> extract(blocks, sdf).to_trimesh().is_watertight, round(blocks.fraction, 2)
    (True, 0.14)
    """

    def __init__(self, lattice: Lattice, blocks: UInt32, sdf: Callable[[BlockLattice], Float]):
        uint_t = type(blocks)
        if dr.width(blocks) == 0:
            blocks = dr.zeros(uint_t, 1)  # so that no array is empty
        self.lattice, self.blocks = lattice, blocks
        self._uint_t = uint_t
        self._stride = dr.opaque(uint_t, lattice.stride)
        across, ny, nz = (dr.opaque(uint_t, count) for count in _block_counts(lattice))

        self._key = _row_keys(lattice, blocks)
        column, rest = self._key % across, self._key // across
        y, z = rest % self._stride, rest // self._stride
        self._first = column * 32 + self._stride * rest  # the lattice vertex at the start of each row
        left = self._stride - column * 32
        self.exists: UInt32 = dr.select(left >= 32, uint_t(MISSING), (uint_t(1) << (left & 31)) - 1)
        """Per row, bit i: its vertex i lies in the lattice."""
        dr.eval(column, y, z, self._first, self.exists)

        rows = _Table(self._key, (across, self._stride, self._stride), _row_count(lattice))
        lane = dr.arange(uint_t, 8 * dr.width(self._key))
        at = [dr.gather(uint_t, c, lane >> 3) + (lane >> i & 1) for i, c in enumerate((column, y, z))]
        self.upper: UInt32 = rows.find(*at)[0]
        """Eight per row: itself and the seven rows above it, numbered like the corners of a cell."""
        lane = dr.arange(uint_t, 3 * dr.width(self._key))
        row = lane // 3
        at = [
            dr.gather(uint_t, c, row) - dr.select(lane - 3 * row == i, uint_t(1), 0)
            for i, c in enumerate((column, y, z))
        ]
        self.lower: UInt32 = rows.find(*at)[0]
        """Three per row: the rows before it along x, y and z."""
        before, here, after = rows.surrounded(column, y, z)
        edge = dr.select(here, uint_t(0), MISSING) | dr.select(before, uint_t(0), 1)
        self.edge: UInt32 = (edge | dr.select(after, uint_t(0), 1 << 31)) & self.exists
        """Per row, bit i: the lattice has a vertex next to its vertex i that is not stored."""
        dr.eval(self.upper, self.lower, self.edge)

        stored = _Table(blocks, (across, ny, nz), block_count(lattice))
        before, here, after = stored.surrounded(column, y >> 2, z >> 2)
        self._lacking = dr.select(here, uint_t(0), 1)
        self._lacking |= dr.select(before, uint_t(0), 2) | dr.select(after, uint_t(0), 4)
        dr.eval(self._lacking)
        values = dr.detach(sdf(self))
        self.beyond: UInt32 = pack_signs(values) & self.edge
        """Per row, bit i: it is the inside that lies beyond the edge vertex i."""
        dr.eval(self.beyond)
        cells, _ = self.active_cells(values)
        if dr.width(cells) and dr.any(is_set(self.edge, cells))[0]:
            raise UserError(
                "the surface of sdf runs out of the blocks; BlockLattice.around finds those that it needs"
            )

    @classmethod
    def around(
        cls, lattice: Lattice, sdf: Float | Callable[[Array3f], Float], float_t: type[Float] | None = None
    ) -> BlockLattice:
        """The blocks around a surface, found by a scan of the whole lattice.

        Args:
            sdf: signed distance at all vertices of the lattice; or a function that maps points (``Array3f``,
                lattice units) to it, which is evaluated slab by slab: memory does not follow n^3.
            float_t: with a function, the Dr.Jit float type to compute with.
        """
        if not lattice.fits_in_blocks:
            raise UserError(
                f"the grid '{lattice.grid}' cannot be stored in blocks; choose another or leave out the band"
            )
        if not callable(sdf):
            field = dr.detach(sdf.array if dr.is_tensor_v(sdf) else sdf)
            if dr.width(field) != lattice.vertex_count:
                raise UserError(
                    f"sdf has {dr.width(field)} values, but the lattice needs {lattice.vertex_count}"
                )
            cells, _ = active_cells(field, lattice)
            return cls(lattice, _blocks_near(lattice, cells), lambda blocks: blocks.take(field))
        assert float_t is not None, "a function needs a type of numbers to compute with"
        uint_t = dr.uint32_array_t(float_t)
        inside = dr.empty(uint_t, -(-lattice.vertex_count // 32))
        last = dr.opaque(uint_t, lattice.vertex_count - 1)
        for start in range(0, lattice.vertex_count, _SLAB):
            index = dr.arange(uint_t, min(_SLAB, 32 * dr.width(inside) - start)) + dr.opaque(uint_t, start)
            points = lattice.positions_of(dr.minimum(index, last), float_t)
            words = pack_signs(dr.detach(sdf(points)))
            word = dr.arange(uint_t, dr.width(words)) + dr.opaque(uint_t, start // 32)
            dr.scatter(inside, words, word, mode=dr.ReduceMode.Permute)
            dr.eval(inside)
        cells = sign_changes(closed_signs(inside, lattice), lattice)
        return cls(lattice, _blocks_near(lattice, cells), lambda blocks: sdf(blocks.points(float_t)))

    # What a lattice has -------------------------------------------------------------------------------

    @property
    def grid(self) -> str:
        return self.lattice.grid

    @property
    def resolution(self) -> int:
        return self.lattice.resolution

    @property
    def stride(self) -> int:
        return self.lattice.stride

    @property
    def spacing(self) -> float:
        return self.lattice.spacing

    @property
    def max_offset(self) -> float:
        return self.lattice.max_offset

    @property
    def vertex_count(self) -> int:
        """Stored vertices, with those that fill up rows beyond the upper border of the lattice."""
        return 32 * dr.width(self._key)

    @property
    def weight_count(self) -> int:
        """With FlexiCubes 21 per stored vertex, for the cube above it."""
        return 21 * self.vertex_count if self.lattice.weight_count else 0

    def points(self, float_t: type[Float]) -> Array3f:
        """Positions of the stored vertices without offsets, ``Array3f``."""
        return self.positions_of(dr.arange(self._uint_t, self.vertex_count), float_t)

    def positions_of(self, vertex: UInt32, float_t: type[Float]) -> Array3f:
        return self.lattice.positions_of(self.lattice_vertex(vertex), float_t)

    def offset_positions(self, vertex: UInt32, deform: Field | None, float_t: type[Float]) -> Array3f:
        return self.lattice.offset(self.positions_of(vertex, float_t), deform, vertex)

    # The stored vertices ------------------------------------------------------------------------------

    @property
    def fraction(self) -> float:
        """Share of the lattice's blocks that are stored."""
        return dr.width(self.blocks) / block_count(self.lattice)

    def lattice_vertex(self, vertex: UInt32) -> UInt32:
        """Ids in the whole lattice; arbitrary for what fills up rows."""
        return dr.gather(self._uint_t, self._first, vertex >> 5) + (vertex & 31)

    def in_lattice(self, vertex: UInt32) -> Bool:
        """Whether vertices are such, and do not only fill up a row."""
        return is_set(self.exists, vertex)

    def corner(self, vertex: UInt32, corner: UInt32) -> UInt32:
        """The vertex at a corner (bits 0, 1, 2: x, y, z) of the cell above ``vertex``, or ``MISSING``."""
        along = (vertex & 31) + (corner & 1)
        row = dr.gather(self._uint_t, self.upper, vertex >> 5 << 3 | corner & 6 | along >> 5)
        return dr.select(row == MISSING, MISSING, row << 5 | along & 31)

    def neighbour(self, vertex: UInt32, axis: UInt32, up: Bool) -> UInt32:
        """The next vertex up or down an axis (0, 1, 2), or ``MISSING``."""
        along = vertex & 31
        row = vertex >> 5
        within = (axis == 0) & dr.select(up, along != 31, along != 0)
        exists = is_set(self.exists, vertex + 1, within & up)
        above = dr.gather(self._uint_t, self.upper, row << 3 | self._uint_t(1) << axis, up & ~within)
        below = dr.gather(self._uint_t, self.lower, row * 3 + axis, ~up & ~within)
        row = dr.select(within, row, dr.select(up, above, below))
        along = dr.select(axis == 0, along + dr.select(up, self._uint_t(1), 31) & 31, along)
        missing = (row == MISSING) | (within & up & ~exists)
        return dr.select(missing, MISSING, row << 5 | along)

    def neighbours(self, vertex: UInt32) -> list[UInt32]:
        """Ids of the nearest stored vertices, as of a lattice: the vertex itself where there is none."""
        mask_t = dr.mask_t(self._uint_t)
        found = (
            self.neighbour(vertex, self._uint_t(axis), mask_t(up))
            for axis in range(3)
            for up in (False, True)
        )
        return [dr.select(neighbour == MISSING, vertex, neighbour) for neighbour in found]

    def signs(self, sdf: Float) -> UInt32:
        """Per row, bit i: its vertex i is inside. Those at the edge are what they were."""
        return (pack_signs(sdf) & ~self.edge) | self.beyond

    def active_cells(self, sdf: Float) -> tuple[UInt32, UInt32]:
        """Cells whose corners have different signs, as ``sign_scan.active_cells`` of a whole lattice. What is
        not stored has the sign of the edge."""
        inside = self.signs(sdf)
        if self.lattice.closes_at_border:
            inside &= ~self.border
        dr.eval(inside)
        uint_t = self._uint_t
        row = dr.arange(uint_t, dr.width(inside))
        active = dr.zeros(uint_t)
        for corner in range(1, 8):
            near = dr.gather(uint_t, self.upper, row * 8 + (corner & 6))
            exists = near != MISSING
            other = dr.gather(uint_t, inside, near, exists)
            compared = dr.select(exists, self.exists, 0)
            if corner & 1:
                near = dr.gather(uint_t, self.upper, row * 8 + corner)
                follows = near != MISSING
                other = other >> 1 | dr.gather(uint_t, inside, near, follows) << 31
                compared = compared >> 1 | dr.select(follows, uint_t(1 << 31), 0)
            active |= (other ^ inside) & compared
        return set_bits(active), inside

    @cached_property
    def border(self) -> UInt32:
        """Per row, bit i: its vertex i lies on the border of the whole lattice."""
        last = self._stride - 1
        rest = self._first // self._stride
        x, y, z = self._first - rest * self._stride, rest % self._stride, rest // self._stride
        whole = (y == 0) | (y == last) | (z == 0) | (z == last)
        word = dr.select(whole, self._uint_t(MISSING), 0) | dr.select(x == 0, self._uint_t(1), 0)
        word |= dr.select(last - x < 32, self._uint_t(1) << (last - x & 31), 0)
        dr.eval(word)
        return word

    def take(self, field: Float) -> Float:
        """The values at the stored vertices of a field on the whole lattice, flat with any channels."""
        channels = dr.width(field) // self.lattice.vertex_count
        index = dr.arange(self._uint_t, channels * self.vertex_count)
        vertex = index // channels if channels > 1 else index
        exists = self.in_lattice(vertex)
        source = self.lattice_vertex(vertex) * channels + (index - vertex * channels)
        return dr.gather(type(field), field, source, exists)

    def spread_out(self, field: Float) -> Float:
        """A field on the whole lattice, flat with any channels: what is not stored is as the nearest vertex
        of all those that are. On the host, and as large as the lattice."""
        channels = dr.width(field) // self.vertex_count
        stored = dr.arange(self._uint_t, self.vertex_count)
        exists = self.in_lattice(stored).numpy()
        source = np.full(self.lattice.vertex_count, -1)
        source[self.lattice_vertex(stored).numpy()[exists]] = np.flatnonzero(exists)
        source = source.reshape((self.stride,) * 3)
        nearest = ndimage.distance_transform_edt(source < 0, return_distances=False, return_indices=True)
        values = field.numpy().reshape(-1, channels)[source[tuple(nearest)].ravel()]
        return type(field)(values.ravel())

    # Following a surface ------------------------------------------------------------------------------

    def covers(self, cells: UInt32) -> bool:
        """Whether all blocks within ``MARGIN`` of the cells, given by their lowest vertices, are stored."""
        if dr.width(cells) == 0:
            return True
        along = cells & 31
        needed = self._uint_t(1) | dr.select(along < MARGIN, self._uint_t(2), 0)
        needed |= dr.select(along + MARGIN + 1 >= 32, self._uint_t(4), 0)
        return not dr.any(dr.gather(self._uint_t, self._lacking, cells >> 5) & needed != 0)[0]

    def around_cells(
        self, cells: UInt32, sdf: Callable[[BlockLattice], Float], *, keep: bool = False
    ) -> BlockLattice:
        """The blocks around cells of this one.

        Args:
            cells: their lowest vertices, as in ``SurfaceMesh.cells``.
            sdf: as for the class.
            keep: all blocks of this one stay, too.
        """
        blocks = _blocks_near(self.lattice, self.lattice_vertex(cells), self.blocks if keep else None)
        return BlockLattice(self.lattice, blocks, sdf)

    def find_in(self, other: BlockLattice) -> UInt32:
        """Per stored vertex the same one of another ``BlockLattice`` of this lattice, or ``MISSING``."""
        sizes = (dr.opaque(self._uint_t, _block_counts(self.lattice)[0]), self._stride, self._stride)
        row = _Table(other._key, sizes, _row_count(self.lattice)).values_at(self._key)
        vertex = dr.arange(self._uint_t, self.vertex_count)
        row = dr.gather(self._uint_t, row, vertex >> 5)
        return dr.select(row == MISSING, MISSING, row << 5 | vertex & 31)


class _Table:
    """From coordinates to the rank of what is stored there; a dense array, but of rows or blocks only."""

    def __init__(self, keys: UInt32, sizes: tuple[UInt32, UInt32, UInt32], count: int):
        self._uint_t = type(keys)
        self._sizes = sizes
        self._rank = dr.full(self._uint_t, MISSING, count)
        rank = dr.arange(self._uint_t, dr.width(keys))
        dr.scatter(self._rank, rank, keys, mode=dr.ReduceMode.Permute)
        dr.eval(self._rank)

    def values_at(self, keys: UInt32) -> UInt32:
        return dr.gather(self._uint_t, self._rank, keys)

    def find(self, x: UInt32, y: UInt32, z: UInt32) -> tuple[UInt32, Bool]:
        """The rank at the coordinates, or ``MISSING``, and whether they lie in the lattice."""
        nx, ny, nz = self._sizes
        within = (x < nx) & (y < ny) & (z < nz)  # one before 0 is a huge number
        rank = dr.gather(self._uint_t, self._rank, x + nx * (y + ny * z), within)
        return dr.select(within, rank, MISSING), within

    def surrounded(self, x: UInt32, y: UInt32, z: UInt32) -> list[Bool]:
        """Whether the nine at x - 1, at x and at x + 1 are stored or outside of the lattice."""
        result = []
        for dx in (-1, 0, 1):
            complete = dr.full(dr.mask_t(self._uint_t), True, dr.width(x))
            for dy in (-1, 0, 1):
                for dz in (-1, 0, 1):
                    rank, within = self.find(x + (dx & MISSING), y + (dy & MISSING), z + (dz & MISSING))
                    complete &= (rank != MISSING) | ~within
            dr.eval(complete)
            result.append(complete)
        return result


def _block_counts(lattice: Lattice) -> tuple[int, int, int]:
    nx, ny, nz = (-(-lattice.stride // side) for side in BLOCK)
    return nx, ny, nz


def block_count(lattice: Lattice) -> int:
    """How many blocks a whole lattice has."""
    nx, ny, nz = _block_counts(lattice)
    return nx * ny * nz


def _row_count(lattice: Lattice) -> int:
    return _block_counts(lattice)[0] * lattice.stride**2


def _row_keys(lattice: Lattice, blocks: UInt32) -> UInt32:
    """Numbers ``column + nx (y + stride z)`` of the rows of blocks, ascending."""
    uint_t = type(blocks)
    nx, ny, _ = (dr.opaque(uint_t, count) for count in _block_counts(lattice))
    stride = dr.opaque(uint_t, lattice.stride)
    lane = dr.arange(uint_t, dr.width(blocks) * BLOCK[1] * BLOCK[2])
    block, row = dr.gather(uint_t, blocks, lane // 16), lane & 15
    y = block // nx % ny * 4 + (row & 3)
    z = block // (nx * ny) * 4 + (row >> 2)
    key = block % nx + nx * (y + stride * z)
    stored = dr.zeros(uint_t, _row_count(lattice))
    dr.scatter(stored, uint_t(1), key, (y < stride) & (z < stride), mode=dr.ReduceMode.Permute)
    return dr.compress(stored == 1)


def _blocks_near(lattice: Lattice, cells: UInt32, others: UInt32 | None = None) -> UInt32:
    """Ids of the blocks within ``MARGIN`` of cells, and of the ``others``."""
    uint_t = type(cells)
    counts = _block_counts(lattice)
    near = dr.zeros(uint_t, block_count(lattice))
    nx, ny = dr.opaque(uint_t, counts[0]), dr.opaque(uint_t, counts[1])
    if dr.width(cells):
        stride = dr.opaque(uint_t, lattice.stride)
        row = cells // stride
        z = row // stride
        x, y = cells - row * stride, row - z * stride
        rows = nx * ((y >> 2) + ny * (z >> 2))
        # Along x the blocks are long, and their neighbours are seldom near.
        dr.scatter(near, uint_t(1), (dr.maximum(x, MARGIN) - MARGIN >> 5) + rows)
        dr.scatter(near, uint_t(1), (dr.minimum(x + MARGIN + 1, stride - 1) >> 5) + rows)
    index = dr.arange(uint_t, dr.width(near))
    across = ((nx, index // nx % ny, counts[1]), (nx * ny, index // (nx * ny), counts[2]))
    for step, coordinate, size in across:
        before = dr.gather(uint_t, near, index - step, coordinate > 0)
        after = dr.gather(uint_t, near, index + step, coordinate + 1 < dr.opaque(uint_t, size))
        near = near | before | after
        dr.eval(near)
    if others is not None:
        dr.scatter(near, uint_t(1), others)
    return dr.compress(near == 1)
