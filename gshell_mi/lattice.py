"""The lattices on which the fields live: cubic cells, whole or split into tetrahedra."""

import importlib
from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from .errors import UserError

#: Offset of a lattice vertex, in cells and along each axis, that ``deform = 1`` stands for.
#:
#: The signed volume of a Kuhn tetrahedron is linear in every single vertex coordinate, so its minimum
#: over all offsets in [-c, c]^12 is taken at a corner of that box; over the 4096 corners the smallest c
#: at which it reaches 0 is 1/6 (where it is 1 - 6c: the four vertices move by +c, -c, +c, -c along each
#: axis, up to signs). Half the shortest edge, 1/2, would not do. Below 1/6 no tetrahedron inverts
#: whatever the offsets are, hence the lattice stays embedded and no surface in it intersects itself; at
#: 0.15 the flattest tetrahedron keeps a tenth of its volume, which also keeps triangles from degenerating.
MAX_OFFSET_CELLS = 0.15


@dataclass(frozen=True)
class Lattice:
    """Vertices on [-1, 1]^3 with ``resolution`` cells per side.

    Vertex ``(x, y, z)`` with 0 <= x, y, z <= resolution has the id ``x + y S + z S^2``,
    ``S = resolution + 1``: a flat field reshaped in NumPy's (C) order to ``(S, S, S)`` is indexed
    ``[z, y, x]``. All lengths are in lattice units, in which the cube has the side 2. The subclasses
    share the vertices and differ in how a surface is extracted from fields on them.

    Raises:
        UserError: the resolution is not between 1 and 800.

    >>> lattice = TetLattice(2)
    >>> lattice.vertex_count, lattice.spacing
    (27, 1.0)
    >>> lattice.vertex_positions()[5]
    array([ 1.,  0., -1.], dtype=float32)
    """

    grid: ClassVar[str] = ""
    """Name of the kind of lattice, the shape plugin's parameter ``grid``."""

    @property
    def weight_count(self) -> int:
        """Values of the field ``weights``, which only FlexiCubes have."""
        return 0

    resolution: int

    def __post_init__(self):
        if not 1 <= self.resolution <= 800:
            raise UserError(
                f"lattice resolution must be between 1 and 800 cells per side, not {self.resolution}"
            )

    @property
    def stride(self) -> int:
        """Vertices per side, ``resolution + 1``."""
        return self.resolution + 1

    @property
    def vertex_count(self) -> int:
        return self.stride**3

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
        axis = np.linspace(-1.0, 1.0, self.stride, dtype=np.float32)
        z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
        return np.stack([x, y, z], axis=-1).reshape(-1, 3)

    def points(self, float_t: type) -> Any:
        """The same positions as a Dr.Jit ``Array3f``, for fields evaluated on the device.

        Args:
            float_t: the Dr.Jit float type to compute with, e.g. ``drjit.llvm.ad.Float`` or ``mi.Float``.

        >>> import drjit.llvm.ad as d
        >>> sphere = dr.norm(TetLattice(8).points(d.Float)) - 0.5
        >>> dr.width(sphere)
        729
        """
        return self.positions_of(dr.arange(dr.uint32_array_t(float_t), self.vertex_count), float_t)

    def positions_of(self, vertex: Any, float_t: type) -> Any:
        """Positions of the vertices with the ids ``vertex``, without offsets, as ``Array3f``."""
        uint32_t = dr.uint32_array_t(float_t)
        stride = dr.opaque(uint32_t, self.stride)
        row = vertex // stride
        z = row // stride
        cell = dr.opaque(float_t, self.spacing)
        array3f_t = array_type(float_t, "Array3f")
        return array3f_t(
            dr.fma(float_t(vertex - row * stride), cell, -1),
            dr.fma(float_t(row - z * stride), cell, -1),
            dr.fma(float_t(z), cell, -1),
        )

    def offset_positions(self, vertex: Any, deform: Any, float_t: type) -> Any:
        """Positions of the vertices with the ids ``vertex``, offset by ``deform`` unless that is None."""
        return self.offset(self.positions_of(vertex, float_t), deform, vertex)

    def offset(self, p: Any, deform: Any, index: Any) -> Any:
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


@dataclass(frozen=True)
class FlexiCubesLattice(Lattice):
    """Cubes with a vertex inside (``flexicubes``): dual marching cubes with weights per cube.

    The vertices on its border count as outside, so the template is always closed.
    """

    grid: ClassVar[str] = "flexicubes"

    @property
    def weight_count(self) -> int:
        """21 per cube: alpha of its corners, beta of its edges (``extraction.cube_tables.EDGES``), gamma.

        Cube (x, y, z) is number ``x + y N + z N^2``, N = ``resolution``.
        """
        return 21 * self.resolution**3


_KINDS: dict[str, type[Lattice]] = {kind.grid: kind for kind in (TetLattice, CubeLattice, FlexiCubesLattice)}

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


def array_type(float_t: type, name: str) -> type:
    """The Dr.Jit type ``name`` (``"Array3f"``, ``"Array3u"``) of the backend that ``float_t`` belongs to.

    >>> import drjit.llvm.ad as d
    >>> array_type(d.Float, "Array3u") is d.Array3u
    True
    """
    return getattr(importlib.import_module(float_t.__module__), name)
