"""Marching tetrahedra cut by the mSDF, on a Kuhn lattice and without any sort.

The template is marched as by Doi and Koide (1991); the cut is that of G-Shell (Liu et al., "Ghost on the
Shell", ICLR 2024, sec. 3): the mSDF is interpolated at the isosurface vertices and the isosurface polygon
is clipped where it is negative. As every edge and face of the lattice is a vertex plus a type
(``tables``), the vertices of the mesh are numbered without searching for duplicates:

1. One pass over the signs finds the active cells. A cell owns the 7 edges and 12 faces whose lowest
   vertex is its own; a cell none of whose edges is crossed owns no crossed face either.
2. The number of crossed edges before a cell (a prefix sum) plus the rank of an edge in its cell is the
   edge's vertex. One dense array, never cleared, holds both for every active cell.
3. The cut runs through faces of the lattice, so its vertices are numbered in the same way by the faces.
   Both tetrahedra at a face find the same number: the boundary is welded by construction.

Everything up to here is detached. Derivatives flow through the final formula for the vertices only.
"""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from ..errors import UserError
from ..lattice import TetLattice, array_type
from . import tables
from .surface_mesh import CutPoints, EdgePoints, Stencil, SurfaceMesh, concatenate, gather

#: Field values smaller than this count as this, so that gradients of slivers stay below 1e7.
FIELD_FLOOR = 1e-7

#: Values below this are negative. Not 0: some threads flush denormal numbers to 0 and others do not.
_NEGATIVE = -(2.0**-126)

_MAX_VERTICES = 1 << 25  # what fits beside 7 edge bits in the 32 bits of a cell's record


def _expand(bits: Any, log2_slots: int) -> tuple[Any, Any]:
    """The set bits of an array of bit sets in order, as (index of the set, number of the bit)."""
    uint_t = type(bits)
    mask = (1 << log2_slots) - 1
    lane = dr.arange(uint_t, dr.width(bits) << log2_slots)
    lane = dr.compress(dr.gather(uint_t, bits, lane >> log2_slots) >> (lane & mask) & 1 == 1)
    if dr.width(lane) == 0:  # literals of size 1 do not go together with arrays of size 0
        return lane, lane
    return lane >> log2_slots, lane & mask


@dataclass(frozen=True)
class _Polygons:
    """Isosurface polygons, one per active tetrahedron."""

    base: Any  # lowest lattice vertex of the cell
    key: Any  # entry in the tables: tetrahedron * 256 + signs of the cell's corners
    quad: Any  # 1 if there are four vertices, else 0
    corners: list  # their mesh vertices; the fourth of a triangle is its first

    def at(self, index: Any) -> "_Polygons":
        uint_t = type(index)
        base, key, quad, *corners = (
            dr.gather(uint_t, x, index) for x in (self.base, self.key, self.quad, *self.corners)
        )
        return _Polygons(base, key, quad, corners)

    def renumbered(self, order: Any) -> "_Polygons":
        result = replace(self, corners=[dr.gather(type(order), order, c) for c in self.corners])
        dr.eval(result.corners)
        return result


class TetExtraction:
    """One extraction; holds the types and constants that its steps share."""

    def __init__(self, lattice: TetLattice, float_t: type):
        self.lattice = lattice
        self.float_t = float_t
        self.uint_t = uint_t = dr.uint32_array_t(float_t)
        self.vertices_t = array_type(float_t, "Array3f")
        self.faces_t = array_type(float_t, "Array3u")
        # Opaque, so that all resolutions share their kernels.
        self.stride = dr.opaque(uint_t, lattice.stride)
        self.plane = dr.opaque(uint_t, lattice.stride**2)
        # A corner cut off at the margin from a triangle that is itself cut off at the margin then still
        # spans 16 units in the last place of a coordinate near 1.
        self.margin = dr.opaque(float_t, (16 * 2.0**-24 / lattice.spacing) ** 0.5)

    def run(self, sdf: Any, msdf: Any, deform: Any, with_template: bool) -> SurfaceMesh:
        """The mesh of flat fields that ``extract`` has checked."""
        s = dr.detach(sdf)
        cell = self.candidate_cells(s)
        if dr.width(cell) == 0:
            return self.empty_mesh(with_template)
        signs, crossed, tets = self.classify(s, cell)
        owner, difference = _expand(crossed, 3)
        count = dr.width(owner)
        if count == 0:
            return self.empty_mesh(with_template)
        if count >= _MAX_VERTICES:
            raise UserError(
                f"the surface has {count} vertices, more than the {_MAX_VERTICES} supported; "
                "sdf should be smoother or the lattice coarser"
            )
        record = self.record_cells(cell, crossed)
        a = dr.gather(self.uint_t, cell, owner)
        b = a + self.corner_offset(difference)
        dr.eval(a, b)
        polygons = self.polygons(cell, signs, tets, record)

        kept_count = count
        if msdf is not None:
            positive = self.edge_points(s, a, b).interpolate(dr.detach(msdf)) >= _NEGATIVE
            kept, dropped = dr.compress(positive), dr.compress(~positive)
            kept_count = dr.width(kept)
        if kept_count == 0 and not with_template:
            return self.empty_mesh(False)
        if kept_count in (0, count):
            points = self.edge_points(sdf, a, b)
            uncut = self.mesh((points,), self.triangulate(polygons), msdf, deform, kept_count)
            mesh = uncut if kept_count else self.empty_mesh(False)
            return replace(mesh, template=uncut) if with_template else mesh

        # Kept vertices first, so that those of the open surface and of its template agree.
        order = dr.empty(self.uint_t, count)
        dr.scatter(order, dr.arange(self.uint_t, kept_count), kept, mode=dr.ReduceMode.Permute)
        rest = dr.arange(self.uint_t, count - kept_count) + dr.opaque(self.uint_t, kept_count)
        dr.scatter(order, rest, dropped, mode=dr.ReduceMode.Permute)
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

    # Classification -----------------------------------------------------------------------------------

    def corner_offset(self, corner: Any) -> Any:
        """Difference between the ids of a cell's corner and of its lowest vertex."""
        return (corner & 1) + (corner >> 1 & 1) * self.stride + (corner >> 2) * self.plane

    def candidate_cells(self, s: Any) -> Any:
        """Cells whose corners have different signs, by their lowest vertex, and few others.

        This is the one pass over the whole field, so the field is read once and packed into one bit per
        vertex; a neighbour is then a shift in the stream of bits. The vertices at the upper borders count
        as cells too, for the edges that they own. Their corners outside the lattice are wrapped around
        here and seen to in ``classify``.
        """
        uint_t = self.uint_t
        count = dr.width(s)
        word = dr.arange(uint_t, -(-count // 32))
        last_vertex, last_word = dr.opaque(uint_t, count - 1), dr.opaque(uint_t, (count - 1) // 32)
        inside = dr.zeros(uint_t)
        for bit in range(32):
            vertex = dr.minimum(word * 32 + bit, last_vertex)
            inside |= dr.select(dr.gather(self.float_t, s, vertex) < _NEGATIVE, uint_t(1 << bit), 0)
        dr.eval(inside)

        active = dr.zeros(uint_t)
        for corner in range(1, 8):
            offset = self.corner_offset(uint_t(corner))
            low, shift = word + (offset >> 5), offset & 31
            first = dr.gather(uint_t, inside, dr.minimum(low, last_word))
            second = dr.gather(uint_t, inside, dr.minimum(low + 1, last_word))
            active |= (first >> shift | second << (31 - shift) << 1) ^ inside
        beyond = ~dr.opaque(uint_t, 0) << (last_vertex & 31) << 1  # bits past the last vertex
        active &= ~dr.select(word == last_word, beyond, 0)

        words = dr.compress(active != 0)
        if dr.width(words) == 0:
            return words
        owner, bit = _expand(dr.gather(uint_t, active, words), 5)
        return dr.gather(uint_t, words, owner) * 32 + bit

    def classify(self, s: Any, cell: Any) -> tuple[Any, Any, Any]:
        """Per cell: bits of the corners inside, of the differences to crossed edges, of active tets."""
        row = cell // self.stride
        z = row // self.stride
        last = self.stride - 1
        border = dr.select(cell - row * self.stride == last, self.uint_t(1), 0)
        border |= dr.select(row - z * self.stride == last, self.uint_t(2), 0)
        border |= dr.select(z == last, self.uint_t(4), 0)
        # A corner outside the lattice takes the sign of the cell's own vertex: no edge there is crossed.
        own = dr.gather(self.float_t, s, cell) < _NEGATIVE
        signs = dr.select(own, self.uint_t(1), 0)
        for corner in range(1, 8):
            exists = border & corner == 0
            neighbour = cell + self.corner_offset(self.uint_t(corner))
            inside = dr.gather(self.float_t, s, neighbour, active=exists) < _NEGATIVE
            signs |= dr.select(dr.select(exists, inside, own), self.uint_t(1 << corner), 0)
        crossed = signs ^ dr.select(own, self.uint_t(255), 0)
        tets = dr.gather(self.uint_t, self.uint_t(tables.active_tets_table()), signs, active=border == 0)
        dr.eval(signs, crossed, tets)
        return signs, crossed, tets

    def record_cells(self, cell: Any, crossed: Any) -> Any:
        """Dense array that holds, for every active cell, its first mesh vertex and its crossed edges.

        Entries of other cells are arbitrary and never read.
        """
        first = dr.prefix_reduce(dr.ReduceOp.Add, dr.popcnt(crossed))
        record = dr.empty(self.uint_t, self.lattice.vertex_count)
        dr.scatter(record, first << 7 | crossed >> 1, cell, mode=dr.ReduceMode.Permute)
        return record

    def polygons(self, cell: Any, signs: Any, tets: Any, record: Any) -> _Polygons:
        """The isosurface polygon of every active tetrahedron."""
        owner, tet = _expand(tets, 3)
        base = dr.gather(self.uint_t, cell, owner)
        key = tet * 256 + dr.gather(self.uint_t, signs, owner)
        packed = dr.gather(self.uint_t, self.uint_t(tables.polygon_table()), key)
        quad = packed >> 24
        corners = []
        for i in range(4):
            edge = packed >> (6 * i) & 63
            active = quad == 1 if i == 3 else True
            entry = dr.gather(self.uint_t, record, base + self.corner_offset(edge >> 3), active=active)
            below = (self.uint_t(1) << ((edge & 7) - 1)) - 1
            corners.append((entry >> 7) + dr.popcnt(entry & below))
        corners[3] = dr.select(quad == 1, corners[3], corners[0])
        polygons = _Polygons(base, key, quad, corners)
        dr.eval(base, key, quad, corners)
        return polygons

    # Faces --------------------------------------------------------------------------------------------

    def triangulate(self, polygons: _Polygons, slots: Any = None) -> Any:
        """Triangles of whole polygons; a quad is split from its first to its third vertex.

        Args:
            slots: bits of the triangles that each polygon gives; None for all.
        """
        polygon, second = _expand(polygons.quad * 2 + 1 if slots is None else slots, 1)
        if dr.width(polygon) == 0:
            return dr.zeros(self.faces_t, 0)
        c0, c1, c2, c3 = (dr.gather(self.uint_t, c, polygon) for c in polygons.corners)
        faces = self.faces_t(c0, dr.select(second == 1, c2, c1), dr.select(second == 1, c3, c2))
        dr.eval(faces)
        return faces

    def clip(self, polygons: _Polygons, record: Any, count: int, kept_count: int) -> tuple[Any, Any, Any]:
        """Faces of the kept part of all polygons, and the ends of the segments that cut vertices lie on.

        Returns:
            ``faces`` (indices from ``kept_count`` on are cut vertices) and per cut vertex the kept vertex
            and the dropped one, the latter counted from the first dropped.
        """
        kept_opaque = dr.opaque(self.uint_t, kept_count)
        stays = [c < kept_opaque for c in polygons.corners]
        kept = dr.zeros(self.uint_t)
        for i, stay in enumerate(stays):
            kept |= dr.select(stay, self.uint_t(1 << i), 0)
        whole = kept == 15  # the fourth corner of a triangle is its first
        mixed = dr.compress((kept != 0) & ~whole)
        faces = self.triangulate(polygons, dr.select(whole, polygons.quad * 2 + 1, 0))
        if dr.width(mixed) == 0:
            return faces, mixed, mixed

        polygons = polygons.at(mixed)
        quad = polygons.quad == 1
        stays = [c < kept_opaque for c in polygons.corners]
        sides = dr.gather(self.uint_t, self.uint_t(tables.side_table()), polygons.key)
        owners, kinds, cuts, ends = [], [], [], []
        for i in range(4):
            # The third side of a triangle ends at its fourth corner, which is its first.
            j = (i + 1) % 4
            cut = stays[i] != stays[j]
            cuts.append(cut if i < 3 else cut & quad)
            side = sides >> (7 * i) & 127
            entry = dr.gather(self.uint_t, record, polygons.base + self.corner_offset(side >> 4), cuts[i])
            owners.append(entry >> 7)  # the first vertex of a cell names the cell
            kinds.append(side & 15)
            start = dr.select(stays[i], polygons.corners[i], polygons.corners[j])
            end = dr.select(stays[i], polygons.corners[j], polygons.corners[i])
            ends.append((start, end - kept_opaque))

        cut_faces = dr.zeros(self.uint_t, count)  # per cell: bits of its faces that are cut
        for owner, kind, cut in zip(owners, kinds, cuts, strict=True):
            bit = self.uint_t(1) << kind
            dr.scatter_reduce(dr.ReduceOp.Or, cut_faces, bit, owner, cut, dr.ReduceMode.Local)
        before = dr.prefix_reduce(dr.ReduceOp.Add, dr.popcnt(cut_faces))
        cut_count = dr.sum(dr.popcnt(cut_faces))[0]

        starts, stops = dr.empty(self.uint_t, cut_count), dr.empty(self.uint_t, cut_count)
        slot = dr.arange(self.uint_t, dr.width(mixed)) * 8
        local = dr.empty(self.uint_t, 8 * dr.width(mixed))
        for i in range(4):
            below = dr.gather(self.uint_t, cut_faces, owners[i], cuts[i]) & ((self.uint_t(1) << kinds[i]) - 1)
            cut_vertex = dr.gather(self.uint_t, before, owners[i], cuts[i]) + dr.popcnt(below)
            # Both polygons at a face write the same values.
            dr.scatter(starts, ends[i][0], cut_vertex, cuts[i], mode=dr.ReduceMode.Permute)
            dr.scatter(stops, ends[i][1], cut_vertex, cuts[i], mode=dr.ReduceMode.Permute)
            dr.scatter(local, polygons.corners[i], slot + i, mode=dr.ReduceMode.Permute)
            dr.scatter(local, kept_opaque + cut_vertex, slot + 4 + i, cuts[i], mode=dr.ReduceMode.Permute)

        kept = sum(dr.select(stay, self.uint_t(1 << i), 0) for i, stay in enumerate(stays))
        entry = dr.gather(
            self.uint_t,
            self.uint_t(tables.clip_table()),
            dr.select(quad, kept + 16, kept & 7),
        )
        dr.eval(entry)
        polygon, triangle = _expand((self.uint_t(1) << (entry >> 27)) - 1, 2)
        packed = dr.gather(self.uint_t, entry, polygon) >> (9 * triangle)
        clipped = self.faces_t(
            *(dr.gather(self.uint_t, local, polygon * 8 + (packed >> 3 * i & 7)) for i in range(3))
        )
        if dr.width(faces) == 0:
            dr.eval(clipped)
            return clipped, starts, stops
        return concatenate([faces, clipped]), starts, stops

    # Vertices -----------------------------------------------------------------------------------------

    def zero_crossing(self, x0: Any, x1: Any) -> Any:
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
        # Halved, as the sum of two finite numbers may overflow.
        return 0.5 * m0 / (0.5 * m0 + 0.5 * m1)

    def edge_points(self, sdf: Any, a: Any, b: Any) -> EdgePoints:
        s_a, s_b = gather(self.float_t, sdf, a), gather(self.float_t, sdf, b)
        return EdgePoints(a, b, self.zero_crossing(s_a, s_b))

    def mesh(self, blocks: tuple, faces: Any, msdf: Any, deform: Any, kept_count: int) -> SurfaceMesh:
        def position(vertex):
            p = self.lattice.positions_of(vertex, self.float_t)
            if deform is None:
                return p
            offset = dr.clip(gather(self.vertices_t, deform, vertex), -1, 1)
            return dr.fma(offset, dr.opaque(self.float_t, self.lattice.max_offset), p)

        stencil = Stencil(blocks)
        vertices = stencil.apply(position)
        if msdf is None:
            msdf = dr.full(self.float_t, 1, stencil.count)
        else:
            # The cut lies at 0, which interpolation gives but for rounding.
            zeros = [dr.zeros(self.float_t, block.count) for block in blocks if isinstance(block, CutPoints)]
            edges = [block.interpolate(msdf) for block in blocks if isinstance(block, EdgePoints)]
            msdf = concatenate(edges + zeros)
        dr.eval(vertices, msdf, [block.t for block in blocks])
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
