"""The kinds of lattices: cubic cells, whole or split into tetrahedra."""

import importlib
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import numpy as np

from ..arrays import AnyArray, Array3f, Field, Float, UInt32
from ..errors import UserError

#: Cells per side; ``deform``, three numbers per vertex, ends at 2^32 values soon after.
MOST_CELLS = 800

#: Stands for a vertex that does not exist.
MISSING = 0xFFFFFFFF

#: Offset of a lattice vertex, in cells and along each axis, that ``deform = 1`` stands for.
#:
#: The signed volume of a Kuhn tetrahedron is linear in every single vertex coordinate, so its minimum
#: over all offsets in [-c, c]^12 is taken at a corner of that box; over the 4096 corners the smallest c
#: at which it reaches 0 is 1/6 (where it is 1 - 6c: the four vertices move by +c, -c, +c, -c along each
#: axis, up to signs). Half the shortest edge, 1/2, would not do. Below 1/6 no tetrahedron inverts
#: whatever the offsets are, hence the lattice stays embedded and no surface in it intersects itself; at
#: 0.15 the flattest tetrahedron keeps a tenth of its volume, which also keeps triangles from degenerating.
MAX_OFFSET_CELLS = 0.15

#: The same for the body-centred cubic lattice, whose tetrahedra are fatter: there the smallest volume is
#: (1 - 4c)^2 of the whole one, again a tenth.
MAX_OFFSET_CELLS_BCC = 0.17


@dataclass(frozen=True)
class CubicGrid:
    """Vertices of a lattice in rows, columns and layers.

    Vertex ``(x, y, z)`` with 0 <= x, y, z < ``stride`` has the id ``first + x + y stride + z stride^2`` and
    lies at ``origin + spacing (x, y, z)``, in lattice units.
    """

    first: int
    stride: int
    origin: float
    spacing: float

    @property
    def ids(self) -> slice:
        """The part of a field of one value per lattice vertex that belongs to the grid."""
        return slice(self.first, self.first + self.stride**3)

    def axis(self) -> np.ndarray:
        """The coordinates of its vertices along any axis, float64."""
        return self.origin + self.spacing * np.arange(self.stride)


@dataclass(frozen=True)
class Lattice:
    """Vertices on [-1, 1]^3 with ``resolution`` cells per side.

    Vertex ``(x, y, z)`` with 0 <= x, y, z <= resolution has the id ``x + y S + z S^2``,
    ``S = resolution + 1``: a flat field reshaped in NumPy's (C) order to ``(S, S, S)`` is indexed
    ``[z, y, x]``. All lengths are in lattice units, in which the cube has the side 2. The subclasses
    differ in how a surface is extracted from fields on them; only ``BccLattice`` has other vertices too.

    Raises:
        UserError: the resolution is not between 1 and ``MOST_CELLS``.

    >>> lattice = TetLattice(2)
    >>> lattice.vertex_count, lattice.spacing
    (27, 1.0)
    >>> lattice.vertex_positions()[5]
    array([ 1.,  0., -1.], dtype=float32)
    """

    grid: ClassVar[str] = ""
    """Name of the kind of lattice, the shape plugin's parameter ``grid``."""

    fits_in_blocks: ClassVar[bool] = True
    """Whether its fields can be stored in blocks, see ``BlockLattice``."""

    closes_at_border: ClassVar[bool] = False
    """Whether the vertices on its border count as outside."""

    joins_across_faces: ClassVar[bool] = False
    """Whether the surface may pass between any two corners of a face of a cell, not only between those that
    an edge of the lattice joins."""

    @property
    def weight_count(self) -> int:
        """Values of the field ``weights``, which only FlexiCubes have."""
        return 0

    resolution: int

    def __post_init__(self) -> None:
        if not 1 <= self.resolution <= MOST_CELLS:
            raise UserError(
                f"lattice resolution must be between 1 and {MOST_CELLS} cells per side, not {self.resolution}"
            )

    @property
    def stride(self) -> int:
        """Vertices per side, ``resolution + 1``."""
        return self.resolution + 1

    @property
    def grids(self) -> tuple[CubicGrid, ...]:
        """The cubic grids whose vertices, one grid after the other, are those of the lattice."""
        return (CubicGrid(0, self.stride, -1.0, self.spacing),)

    @property
    def cell_vectors(self) -> np.ndarray:
        """From a vertex to the corners 1, 2 and 4 of the cell above it, ``(3, 3)``, one per row; the others
        are their sums."""
        return self.spacing * np.eye(3)

    def corner(self, vertex: UInt32, corner: UInt32) -> UInt32:
        """The vertex at a corner (bits 0, 1, 2: steps along ``cell_vectors``) of the cell above ``vertex``,
        which must have all its corners."""
        return vertex + corner_offset(corner, dr.opaque(type(vertex), self.stride))

    @property
    def vertex_count(self) -> int:
        return len(self.grids) * self.stride**3

    @property
    def spacing(self) -> float:
        """Side of a cell, in lattice units."""
        return 2.0 / self.resolution

    @property
    def max_offset(self) -> float:
        """Greatest offset of a vertex along an axis, in lattice units: that of ``deform = 1``."""
        return MAX_OFFSET_CELLS * self.spacing

    def vertex_positions(self) -> np.ndarray:
        """Positions of all vertices without offsets, ``(vertex_count, 3)`` float32 on the host."""
        positions = []
        for grid in self.grids:
            z, y, x = np.meshgrid(*3 * (grid.axis().astype(np.float32),), indexing="ij")
            positions.append(np.stack([x, y, z], axis=-1).reshape(-1, 3))
        return np.concatenate(positions)

    def on_border(self) -> np.ndarray:
        """The vertices where the lattice ends, ``(vertex_count,)`` bool on the host: a template that is to
        be closed has them outside."""
        ends = np.zeros((len(self.grids), *3 * (self.stride,)), bool)
        for axis in (1, 2, 3):
            np.moveaxis(ends, axis, 0)[[0, -1]] = True
        return ends.ravel()

    def neighbours(self, vertex: UInt32) -> list[UInt32]:
        """Ids of the nearest vertices of each ``vertex``, one array per direction; the vertex itself where
        there is none."""
        x, y, z = self.coordinates(vertex)
        stride = dr.opaque(type(vertex), self.stride)
        found = []
        for coordinate, step in ((x, dr.opaque(type(vertex), 1)), (y, stride), (z, stride * stride)):
            found.append(dr.select(coordinate > 0, vertex - step, vertex))
            found.append(dr.select(coordinate + 1 < stride, vertex + step, vertex))
        return found

    def coordinates(self, vertex: UInt32) -> tuple[UInt32, UInt32, UInt32]:
        """Number of each vertex in its row, column and layer."""
        stride = dr.opaque(type(vertex), self.stride)
        row = vertex // stride
        z = row // stride
        return vertex - row * stride, row - z * stride, z

    def points(self, float_t: type[Float]) -> Array3f:
        """The same positions as a Dr.Jit ``Array3f``, for fields evaluated on the device.

        Args:
            float_t: the Dr.Jit float type to compute with, e.g. ``drjit.llvm.ad.Float`` or ``mi.Float``.

        >>> import drjit.llvm.ad as d
        >>> sphere = dr.norm(TetLattice(8).points(d.Float)) - 0.5
        >>> dr.width(sphere)
        729
        """
        return self.positions_of(dr.arange(dr.uint32_array_t(float_t), self.vertex_count), float_t)

    def positions_of(self, vertex: UInt32, float_t: type[Float]) -> Array3f:
        """Positions of the vertices with the ids ``vertex``, without offsets, as ``Array3f``."""
        cell = dr.opaque(float_t, self.spacing)
        array3f_t = array_type(float_t, "Array3f")
        return array3f_t(*(dr.fma(float_t(number), cell, -1) for number in self.coordinates(vertex)))

    def offset_positions(self, vertex: UInt32, deform: Field | None, float_t: type[Float]) -> Array3f:
        """Positions of the vertices with the ids ``vertex``, offset by ``deform`` unless that is None."""
        return self.offset(self.positions_of(vertex, float_t), deform, vertex)

    def offset(self, p: Array3f, deform: Field | None, index: UInt32) -> Array3f:
        """Positions p moved by the offsets at ``index`` of ``deform``, unless that is None."""
        if deform is None:
            return p
        offset = dr.gather(type(p), deform, index, mode=dr.ReduceMode.Local)
        return dr.fma(dr.clip(offset, -1, 1), dr.opaque(dr.leaf_t(p), self.max_offset), p)


@dataclass(frozen=True)
class TetLattice(Lattice):
    """Kuhn tetrahedra (``tet``): marching tetrahedra.

    Each cell is split along the diagonal from its lowest to its highest corner (Kuhn 1960; Freudenthal
    1942). The split is the same in every cell, so neighbours share their faces, and every edge and every
    face of the lattice is its lowest vertex plus one of 7 edge or 12 face types
    (``extraction.tet_tables``).
    """

    grid: ClassVar[str] = "tet"


@dataclass(frozen=True)
class CubeLattice(Lattice):
    """Whole cubes (``cube``): marching cubes. A third of the vertices and half of the triangles of
    ``TetLattice``."""

    grid: ClassVar[str] = "cube"
    joins_across_faces: ClassVar[bool] = True


@dataclass(frozen=True)
class FlexiCubesLattice(Lattice):
    """Cubes with a vertex inside (``flexicubes``): dual marching cubes with weights per cube.

    The vertices on its border count as outside, so the template is always closed.
    """

    grid: ClassVar[str] = "flexicubes"
    closes_at_border: ClassVar[bool] = True
    joins_across_faces: ClassVar[bool] = True

    @property
    def weight_count(self) -> int:
        """21 per cube: alpha of its corners, beta of its edges (``extraction.cube_tables.EDGES``), gamma.

        Cube (x, y, z) is number ``x + y N + z N^2``, N = ``resolution``.
        """
        return 21 * self.resolution**3


@dataclass(frozen=True)
class BccLattice(Lattice):
    """Body-centred cubic lattice (``bcc``): marching tetrahedra nearer to isotropic than Kuhn's.

    Its vertices are those of two cubic grids of ``(resolution + 1)^3`` vertices, one after the other, the
    second shifted by half a cell along each axis: a flat field reshaped to ``(2, S, S, S)`` is indexed
    ``[grid, z, y, x]``. The cells are a little smaller than the other lattices', so that both grids fit into
    [-1, 1]^3. All tetrahedra are congruent: Kuhn's, squeezed along the diagonal that they share.

    >>> BccLattice(4).vertex_count
    250
    """

    grid: ClassVar[str] = "bcc"
    fits_in_blocks: ClassVar[bool] = False

    #: Half diagonals of a cell, in half cells, whose sums are the corners of Kuhn's cell squeezed.
    BASIS: ClassVar[tuple[tuple[int, int, int], ...]] = ((-1, 1, 1), (1, -1, 1), (1, 1, -1))

    @property
    def grids(self) -> tuple[CubicGrid, ...]:
        h, stride = self.spacing, self.stride
        return CubicGrid(0, stride, -1.0, h), CubicGrid(stride**3, stride, -1.0 + h / 2, h)

    @property
    def spacing(self) -> float:
        return 2.0 / (self.resolution + 0.5)

    @property
    def max_offset(self) -> float:
        return MAX_OFFSET_CELLS_BCC * self.spacing

    def neighbours(self, vertex: UInt32) -> list[UInt32]:
        uint_t, stride = type(vertex), dr.opaque(type(vertex), self.stride)
        second = vertex >= stride * stride * stride
        # Along an axis the neighbours in the other grid have this one's number and the one below or above.
        numbers = self.coordinates(vertex)
        both = [(n - dr.select(second, uint_t(0), 1), n + dr.select(second, uint_t(1), 0)) for n in numbers]
        offset = dr.select(second, uint_t(0), stride * stride * stride)
        found = []
        for corner in range(8):
            x, y, z = (both[axis][corner >> axis & 1] for axis in range(3))
            exists = (x < stride) & (y < stride) & (z < stride)  # -1 has wrapped around
            found.append(dr.select(exists, offset + x + stride * (y + stride * z), vertex))
        return found

    @property
    def cell_vectors(self) -> np.ndarray:
        return self.spacing / 2 * np.array(self.BASIS, float)

    def corner(self, vertex: UInt32, corner: UInt32) -> UInt32:
        """The vertex at a corner of the squeezed cell above ``vertex``; ``MISSING`` where there is none."""
        uint_t, stride = type(vertex), dr.opaque(type(vertex), self.stride)
        count = stride * stride * stride
        second = vertex >= count
        bits = [corner >> i & 1 for i in range(3)]
        total = bits[0] + bits[1] + bits[2]
        changes = total & 1  # to the other grid, whose numbers are those of half a cell below or above
        rounding = dr.select(second, changes, uint_t(0) - changes)
        # A step along a basis vector is one of half a cell along two axes, and one back along the third.
        x, y, z = (
            number + (total + 2 - 2 * bit + rounding >> 1) - 1
            for number, bit in zip(self.coordinates(vertex), bits, strict=True)
        )
        exists = (x < stride) & (y < stride) & (z < stride)  # -1 has wrapped around
        found = x + stride * (y + stride * z) + dr.select(second ^ (changes == 1), count, 0)
        return dr.select(exists, found, MISSING)

    def corner_offset(self, corner: int, second: bool) -> int:
        """Difference between the ids of that corner and of the vertex below, of either grid."""
        bits = [corner >> i & 1 for i in range(3)]
        total = sum(bits)
        rounding = (1 if second else -1) * (total & 1)
        steps = ((total - 2 * bit + rounding) // 2 for bit in bits)
        offset = sum(step * self.stride**axis for axis, step in enumerate(steps))
        return offset + (total & 1) * (-1 if second else 1) * self.stride**3

    def coordinates(self, vertex: UInt32) -> tuple[UInt32, UInt32, UInt32]:
        count = dr.opaque(type(vertex), self.stride**3)
        return super().coordinates(vertex - dr.select(vertex >= count, count, 0))

    def positions_of(self, vertex: UInt32, float_t: type[Float]) -> Array3f:
        half = dr.opaque(float_t, self.spacing / 2)
        second = vertex >= dr.opaque(type(vertex), self.stride**3)
        return super().positions_of(vertex, float_t) + dr.select(second, half, 0)


def corner_offset(corner: UInt32, stride: UInt32) -> UInt32:
    """Difference between the ids of a cubic cell's corner (bits 0, 1, 2: x, y, z) and its lowest vertex."""
    return (corner & 1) + (corner >> 1 & 1) * stride + (corner >> 2) * (stride * stride)


_KINDS: dict[str, type[Lattice]] = {
    kind.grid: kind for kind in (TetLattice, CubeLattice, FlexiCubesLattice, BccLattice)
}

#: Names of the kinds of lattices.
GRIDS: tuple[str, ...] = tuple(_KINDS)


def make_lattice(grid: str, resolution: int) -> Lattice:
    """The lattice of the kind ``grid``, one of ``GRIDS``.

    Raises:
        UserError: there is no such kind, or the resolution is out of range.

    >>> make_lattice("cube", 32)
    CubeLattice(resolution=32)
    """
    if grid not in _KINDS:
        raise UserError(f"grid '{grid}' is not available; choose one of {', '.join(GRIDS)}")
    return _KINDS[grid](resolution)


def lattice_of(grid: str, vertex_count: int) -> Lattice:
    """The lattice of the kind ``grid`` that has so many vertices.

    Raises:
        UserError: there is none.

    >>> lattice_of("tet", 27)
    TetLattice(resolution=2)
    """
    per_grid = vertex_count // len(make_lattice(grid, 1).grids)
    resolution = round(per_grid ** (1 / 3)) - 1
    if resolution < 1 or make_lattice(grid, resolution).vertex_count != vertex_count:
        twice = "2 " if grid == BccLattice.grid else ""
        raise UserError(f"{vertex_count} values are not {twice}(resolution + 1)^3, as grid '{grid}' needs")
    return make_lattice(grid, resolution)


def array_type(float_t: type[AnyArray], name: str) -> type[AnyArray]:
    """The Dr.Jit type ``name`` (``"Array3f"``, ``"Array3u"``) of the backend that ``float_t`` belongs to.

    >>> import drjit.llvm.ad as d
    >>> array_type(d.Float, "Array3u") is d.Array3u
    True
    """
    return getattr(importlib.import_module(float_t.__module__), name)
