"""What all extractions share: signs, the numbering of edges, and vertices from edges, without any sort.

As every edge and face of the lattice is a vertex plus a type, the vertices of the mesh are numbered
without searching for duplicates:

1. One pass over the signs finds the active cells. A cell owns the edges whose lowest vertex is its own.
2. The number of crossed edges before a cell (a prefix sum) plus the rank of an edge in its cell is the
   edge's vertex. One array over the lattice, never cleared, holds both for every active cell.
3. The cut runs through faces of the lattice, so its vertices are numbered in the same way. Both polygons
   at a face find the same number: the boundary is welded by construction.

Everything up to here is detached. Derivatives flow through the final formula for the vertices only.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Generic, Protocol, Self, TypeVar

import drjit as dr

from ..arrays import Array3u, Bool, Field, Float, UInt32
from ..errors import UserError
from ..lattice import MISSING, BlockLattice, Lattice, array_type
from ..lattice.lattice import corner_offset
from ..lattice.sign_scan import active_cells
from ..lattice.sign_words import NEGATIVE, expand, is_set
from .surface_mesh import CutPoints, DualPoints, EdgePoints, Points, Stencil, SurfaceMesh, concatenate, gather

#: Field values smaller than this count as this, so that gradients of slivers stay below 1e7.
FIELD_FLOOR = 1e-7

_MAX_VERTICES = 1 << 25  # what fits beside 7 edge bits in the 32 bits of a cell's record


@dataclass(frozen=True)
class ActiveCells:
    """The cells with crossed edges; those at the upper borders are cells for the edges that they own."""

    inside: UInt32
    """The signs of all vertices, 32 to a word."""
    cell: UInt32
    """Ids of their lowest vertices, ascending."""
    signs: UInt32
    """Bit c: corner c is inside."""
    crossed: UInt32
    """Bit d: the edge from the lowest corner to corner d is crossed."""
    border: UInt32
    """Bit i: the cell reaches beyond the lattice along axis i, so that it is no cell. In a body-centred cubic
    lattice, bit c: its corner c does not exist."""


class GridExtraction(ABC):
    """One extraction; holds the types and constants that its steps share."""

    EDGE_DIFFERENCES: ClassVar[int]
    """Bit d: the lattice has edges from the lowest corner of a cell to corner d."""

    def __init__(self, lattice: Lattice | BlockLattice, float_t: type[Float]):
        self.lattice = lattice
        self.float_t = float_t
        self.uint_t = uint_t = dr.uint32_array_t(float_t)
        self.vertices_t = array_type(float_t, "Array3f")
        self.faces_t = array_type(float_t, "Array3u")
        # Opaque, so that all resolutions share their kernels.
        self.stride = dr.opaque(uint_t, lattice.stride)
        # A corner cut off at the margin from a triangle that is itself cut off at the margin then still
        # spans 16 units in the last place of a coordinate near 1.
        self.margin = dr.opaque(float_t, (16 * 2.0**-24 / lattice.spacing) ** 0.5)

    def run(
        self, sdf: Float, msdf: Float | None, deform: Field | None, with_template: bool, weights: Float | None
    ) -> SurfaceMesh:
        """The mesh of flat fields that ``extract`` has checked."""
        cells = self.active_cells(dr.detach(sdf))
        return replace(self.surface(cells, sdf, msdf, deform, with_template, weights), cells=cells.cell)

    @abstractmethod
    def surface(
        self,
        cells: ActiveCells,
        sdf: Float,
        msdf: Float | None,
        deform: Field | None,
        with_template: bool,
        weights: Float | None,
    ) -> SurfaceMesh:
        """The mesh in the active cells."""

    # Edges --------------------------------------------------------------------------------------------

    def corner(self, vertex: UInt32, corner: UInt32) -> UInt32:
        """The lattice vertex at a corner of the cell above ``vertex``; arbitrary where there is none."""
        if isinstance(self.lattice, BlockLattice):
            return self.lattice.corner(vertex, corner)
        return vertex + corner_offset(corner, self.stride)

    def coordinates(self, vertex: UInt32) -> tuple[UInt32, UInt32, UInt32]:
        if isinstance(self.lattice, BlockLattice):
            vertex = self.lattice.lattice_vertex(vertex)
        row = vertex // self.stride
        z = row // self.stride
        return vertex - row * self.stride, row - z * self.stride, z

    def active_cells(self, s: Float) -> ActiveCells:
        """The cells with crossed edges and few others."""
        lattice = self.lattice
        blocks = isinstance(lattice, BlockLattice)
        cell, inside = lattice.active_cells(s) if blocks else active_cells(s, lattice)
        # Operands of size 0 do not go together with others of size 1.
        return self.classify(inside, cell) if dr.width(cell) else ActiveCells(inside, cell, cell, cell, cell)

    def classify(self, inside: UInt32, cell: UInt32) -> ActiveCells:
        border = dr.zeros(self.uint_t)
        for axis, coordinate in enumerate(self.coordinates(cell)):
            border |= dr.select(coordinate == self.stride - 1, self.uint_t(1 << axis), 0)
        # A corner that does not exist takes the sign of the cell's own vertex: no edge there is crossed.
        own = is_set(inside, cell)
        signs = dr.select(own, self.uint_t(1), 0)
        for corner in range(1, 8):
            neighbour = self.corner(cell, self.uint_t(corner))
            exists = (border & corner == 0) & (neighbour != MISSING)
            sign = dr.select(exists, is_set(inside, neighbour, exists), own)
            signs |= dr.select(sign, self.uint_t(1 << corner), 0)
        crossed = (signs ^ dr.select(own, self.uint_t(255), 0)) & self.EDGE_DIFFERENCES
        dr.eval(signs, crossed, border)
        return ActiveCells(inside, cell, signs, crossed, border)

    def crossed_edges(self, cells: ActiveCells) -> tuple[UInt32, UInt32]:
        """The lattice vertices that the crossed edges join, in the order of the mesh vertices on them."""
        owner, difference = expand(cells.crossed, 3)
        count = dr.width(owner)
        if count >= _MAX_VERTICES:
            raise UserError(
                f"the surface has {count} vertices, more than the {_MAX_VERTICES} supported; "
                "sdf should be smoother or the lattice coarser"
            )
        if count == 0:
            return owner, owner
        a = dr.gather(self.uint_t, cells.cell, owner)
        b = self.corner(a, difference)
        dr.eval(a, b)
        return a, b

    def record_edges(self, cells: ActiveCells) -> UInt32:
        """Array over the lattice: for every active cell, its first mesh vertex and its crossed edges.

        Entries of other cells are arbitrary and never read.
        """
        first = dr.prefix_reduce(dr.ReduceOp.Add, dr.popcnt(cells.crossed))
        record = dr.empty(self.uint_t, self.lattice.vertex_count)
        dr.scatter(record, first << 7 | cells.crossed >> 1, cells.cell, mode=dr.ReduceMode.Permute)
        return record

    def edge_vertex(self, record: UInt32, base: UInt32, edge: UInt32, active: Bool | bool = True) -> UInt32:
        """The mesh vertex on an edge (corner << 3 | difference) of the cell ``base``."""
        entry = dr.gather(self.uint_t, record, self.corner(base, edge >> 3), active)
        below = (self.uint_t(1) << ((edge & 7) - 1)) - 1
        return (entry >> 7) + dr.popcnt(entry & below)

    # Vertices -----------------------------------------------------------------------------------------

    def zero_crossing(self, x0: Float, x1: Float) -> Float:
        """Where a linear function with the values x0 and x1 of opposite sign is 0, off both ends.

        Magnitudes that are too small are raised, with the derivative of the identity: a vertex held at
        the margin still feels where the field wants it.
        """
        m0, m1 = dr.abs(dr.detach(x0)), dr.abs(dr.detach(x1))
        ratio = self.margin / (1 - self.margin)
        m0 = dr.maximum(m0, FIELD_FLOOR)
        m1 = dr.maximum(m1, FIELD_FLOOR)
        m0, m1 = dr.maximum(m0, m1 * ratio), dr.maximum(m1, m0 * ratio)
        if dr.grad_enabled(x0, x1):
            m0 = dr.replace_grad(m0, dr.select(x0 < 0, -x0, x0))
            m1 = dr.replace_grad(m1, dr.select(x1 < 0, -x1, x1))
        # Made smaller, as the sum of two finite numbers may overflow, and GPUs take a quotient by more than
        # 2^126 for 0.
        return 0.125 * m0 / (0.125 * m0 + 0.125 * m1)

    def kept_and_dropped(self, points: EdgePoints | DualPoints, msdf: Float) -> tuple[UInt32, UInt32]:
        """Indices of the points where the mSDF is not negative, and of the others."""
        positive = points.interpolate(dr.detach(msdf)) >= NEGATIVE
        return dr.compress(positive), dr.compress(~positive)

    def kept_first(self, kept: UInt32, dropped: UInt32) -> UInt32:
        """New numbers of the vertices, kept ones first, as the open surface and its template share them."""
        kept_count = dr.width(kept)
        order = dr.empty(self.uint_t, kept_count + dr.width(dropped))
        dr.scatter(order, dr.arange(self.uint_t, kept_count), kept, mode=dr.ReduceMode.Permute)
        rest = dr.arange(self.uint_t, dr.width(dropped)) + dr.opaque(self.uint_t, kept_count)
        dr.scatter(order, rest, dropped, mode=dr.ReduceMode.Permute)
        return order

    def edge_points(self, sdf: Float, a: UInt32, b: UInt32) -> EdgePoints:
        s_a, s_b = gather(self.float_t, sdf, a), gather(self.float_t, sdf, b)
        return EdgePoints(a, b, self.zero_crossing(s_a, s_b))

    def mesh(
        self,
        blocks: tuple[Points, ...],
        faces: Array3u,
        msdf: Float | None,
        deform: Field | None,
        kept_count: int,
    ) -> SurfaceMesh:
        stencil = Stencil(blocks)
        vertices = stencil.apply(lambda vertex: self.lattice.offset_positions(vertex, deform, self.float_t))
        if msdf is None:
            msdf = dr.full(self.float_t, 1, stencil.count)
        else:
            # The cut lies at 0, which interpolation gives but for rounding.
            zeros = [dr.zeros(self.float_t, block.count) for block in blocks if isinstance(block, CutPoints)]
            others = [block.interpolate(msdf) for block in blocks if not isinstance(block, CutPoints)]
            msdf = concatenate(others + zeros)
        dr.eval(vertices, msdf, blocks)
        return SurfaceMesh(
            vertices, faces, msdf, self.lattice.vertex_count, stencil, kept_vertex_count=kept_count
        )

    def empty_mesh(self, with_template: bool) -> SurfaceMesh:
        empty = SurfaceMesh(
            vertices=dr.zeros(self.vertices_t, 0),
            faces=dr.zeros(self.faces_t, 0),
            msdf=dr.zeros(self.float_t, 0),
            lattice_vertex_count=self.lattice.vertex_count,
            stencil=None,
        )
        return replace(empty, template=empty) if with_template else empty


class Polygons(Protocol):
    """Isosurface polygons, as a kind of lattice stores them."""

    def renumbered(self, order: UInt32) -> Self:
        """The same with other numbers for the mesh vertices: ``order`` has one for each."""
        ...


PolygonsT = TypeVar("PolygonsT", bound=Polygons)


class MarchingExtraction(GridExtraction, Generic[PolygonsT]):
    """Extractions whose polygons' vertices lie on the edges of the lattice."""

    def surface(
        self,
        cells: ActiveCells,
        sdf: Float,
        msdf: Float | None,
        deform: Field | None,
        with_template: bool,
        weights: Float | None,
    ) -> SurfaceMesh:
        a, b = self.crossed_edges(cells)
        count = dr.width(a)
        if count == 0:
            return self.empty_mesh(with_template)
        record = self.record_edges(cells)
        polygons = self.polygons(cells, record)

        kept_count = count
        if msdf is not None:
            kept, dropped = self.kept_and_dropped(self.edge_points(dr.detach(sdf), a, b), msdf)
            kept_count = dr.width(kept)
        if kept_count == 0 and not with_template:
            return self.empty_mesh(False)
        if msdf is None or kept_count in (0, count):
            points = self.edge_points(sdf, a, b)
            uncut = self.mesh((points,), self.triangulate(polygons), msdf, deform, kept_count)
            mesh = uncut if kept_count else self.empty_mesh(False)
            return replace(mesh, template=uncut) if with_template else mesh

        order = self.kept_first(kept, dropped)
        polygons = polygons.renumbered(order)
        kept_points, dropped_points = (
            self.edge_points(sdf, dr.gather(self.uint_t, a, ids), dr.gather(self.uint_t, b, ids))
            for ids in (kept, dropped)
        )
        template = None
        if with_template:
            blocks = (kept_points, dropped_points)
            template = self.mesh(blocks, self.triangulate(polygons), msdf, deform, kept_count)
        faces, start, end = self.clip(polygons, record, count, kept_count)
        blocks = (kept_points,)
        if dr.width(start):
            start_points, end_points = kept_points.at(start), dropped_points.at(end)
            t = self.zero_crossing(start_points.interpolate(msdf), end_points.interpolate(msdf))
            blocks += (CutPoints(start_points, end_points, t),)
        return replace(self.mesh(blocks, faces, msdf, deform, kept_count), template=template)

    @abstractmethod
    def polygons(self, cells: ActiveCells, record: UInt32) -> PolygonsT:
        """The isosurface polygons of all cells."""

    @abstractmethod
    def triangulate(self, polygons: PolygonsT) -> Array3u:
        """Triangles of whole polygons."""

    @abstractmethod
    def clip(
        self, polygons: PolygonsT, record: UInt32, count: int, kept_count: int
    ) -> tuple[Array3u, UInt32, UInt32]:
        """Faces of the kept part of all polygons, and the ends of the segments that cut vertices lie on.

        Returns:
            ``faces`` (indices from ``kept_count`` on are cut vertices) and per cut vertex the kept vertex
            and the dropped one, the latter counted from the first dropped.
        """
