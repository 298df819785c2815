"""Marching tetrahedra cut by the mSDF, on a Kuhn lattice.

The template is marched as by Doi and Koide (1991); the cut is that of G-Shell (Liu et al., "Ghost on the
Shell", ICLR 2024, sec. 3): the mSDF is interpolated at the isosurface vertices and the isosurface polygon
is clipped where it is negative. A cell owns the 7 edges and 12 faces whose lowest vertex is its own
(``tet_tables``); a cell none of whose edges is crossed owns no crossed face either.
"""

from dataclasses import dataclass, replace

import drjit as dr

from ..arrays import Array3u, UInt32
from ..lattice.sign_words import expand
from . import tet_tables as tables
from .grid_extraction import ActiveCells, MarchingExtraction
from .surface_mesh import concatenate


@dataclass(frozen=True)
class _Polygons:
    """Isosurface polygons, one per active tetrahedron."""

    base: UInt32  # lowest lattice vertex of the cell
    key: UInt32  # entry in the tables: tetrahedron * 256 + signs of the cell's corners
    quad: UInt32  # 1 if there are four vertices, else 0
    corners: list[UInt32]  # their mesh vertices; the fourth of a triangle is its first

    def at(self, index: UInt32) -> "_Polygons":
        uint_t = type(index)
        base, key, quad, *corners = (
            dr.gather(uint_t, x, index) for x in (self.base, self.key, self.quad, *self.corners)
        )
        return _Polygons(base, key, quad, corners)

    def renumbered(self, order: UInt32) -> "_Polygons":
        result = replace(self, corners=[dr.gather(type(order), order, c) for c in self.corners])
        dr.eval(result.corners)
        return result


class TetExtraction(MarchingExtraction[_Polygons]):
    """Marching tetrahedra."""

    EDGE_DIFFERENCES = 0b11111110

    def polygons(self, cells: ActiveCells, record: UInt32) -> _Polygons:
        owner, tet = expand(self.active_tets(cells), 3)
        base = dr.gather(self.uint_t, cells.cell, owner)
        key = tet * 256 + dr.gather(self.uint_t, cells.signs, owner)
        packed = dr.gather(self.uint_t, self.uint_t(tables.polygon_table()), key)
        quad = packed >> 24
        corners = []
        for i in range(4):
            edge = packed >> (6 * i) & 63
            active = quad == 1 if i == 3 else True
            corners.append(self.edge_vertex(record, base, edge, active))
        corners[3] = dr.select(quad == 1, corners[3], corners[0])
        polygons = _Polygons(base, key, quad, corners)
        dr.eval(base, key, quad, corners)
        return polygons

    def active_tets(self, cells: ActiveCells) -> UInt32:
        """Per cell, bit i: the surface passes through its tetrahedron i."""
        table = self.uint_t(tables.active_tets_table())
        return dr.gather(self.uint_t, table, cells.signs, cells.border == 0)

    def triangulate(self, polygons: _Polygons, slots: UInt32 | None = None) -> Array3u:
        """Triangles of whole polygons; a quad is split from its first to its third vertex.

        Args:
            slots: bits of the triangles that each polygon gives; None for all.
        """
        polygon, second = expand(polygons.quad * 2 + 1 if slots is None else slots, 1)
        if dr.width(polygon) == 0:
            return dr.zeros(self.faces_t, 0)
        c0, c1, c2, c3 = (dr.gather(self.uint_t, c, polygon) for c in polygons.corners)
        faces = self.faces_t(c0, dr.select(second == 1, c2, c1), dr.select(second == 1, c3, c2))
        dr.eval(faces)
        return faces

    def clip(
        self, polygons: _Polygons, record: UInt32, count: int, kept_count: int
    ) -> tuple[Array3u, UInt32, UInt32]:
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
            entry = dr.gather(self.uint_t, record, self.corner(polygons.base, side >> 4), cuts[i])
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
        entry = dr.gather(self.uint_t, self.uint_t(tables.clip_table()), dr.select(quad, kept + 16, kept & 7))
        dr.eval(entry)
        polygon, triangle = expand((self.uint_t(1) << (entry >> 27)) - 1, 2)
        packed = dr.gather(self.uint_t, entry, polygon) >> (9 * triangle)
        clipped = self.faces_t(
            *(dr.gather(self.uint_t, local, polygon * 8 + (packed >> 3 * i & 7)) for i in range(3))
        )
        if dr.width(faces) == 0:
            dr.eval(clipped)
            return clipped, starts, stops
        return concatenate([faces, clipped]), starts, stops
