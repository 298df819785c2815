"""Marching cubes cut by the mSDF.

The template is that of Lorensen and Cline (1987) with tables that leave no crack (``cube_tables``). The
mSDF is interpolated at the isosurface vertices and the isosurface polygon of a cube, which may have up to
7 vertices, is clipped where it is negative, before it is split into triangles: so the cut vertices lie on
the polygon's sides, in faces of the lattice. Each side is known by the mesh vertex at its end with the
lower number and by which of the four faces around that vertex's edge holds it.
"""

from dataclasses import dataclass, replace

import drjit as dr

from ..arrays import Array3u, Bool, UInt32
from ..lattice.sign_words import expand
from . import cube_tables as tables
from .grid_extraction import ActiveCells, MarchingExtraction
from .surface_mesh import concatenate


@dataclass(frozen=True)
class _Polygons:
    """Isosurface polygons; up to four per active cube."""

    key: UInt32  # entry in the tables
    size: UInt32  # vertices, 3 to 7
    corners: UInt32  # their mesh vertices, eight slots per polygon

    def at(self, index: UInt32) -> "_Polygons":
        uint_t = type(index)
        slot = dr.arange(uint_t, 8 * dr.width(index))
        source = dr.gather(uint_t, index, slot >> 3) << 3 | slot & 7
        key, size = (dr.gather(uint_t, x, index) for x in (self.key, self.size))
        return _Polygons(key, size, dr.gather(uint_t, self.corners, source))

    def renumbered(self, order: UInt32) -> "_Polygons":
        corners = dr.gather(type(order), order, self.corners)
        dr.eval(corners)
        return replace(self, corners=corners)

    def slots(self) -> tuple[UInt32, Bool]:
        """Per slot of ``corners``: its polygon and whether it holds a vertex."""
        uint_t = type(self.key)
        slot = dr.arange(uint_t, dr.width(self.corners))
        polygon = slot >> 3
        return polygon, slot & 7 < dr.gather(uint_t, self.size, polygon)

    def mask(self, condition: Bool) -> UInt32:
        """Per polygon: bit i tells whether the condition holds in slot i."""
        uint_t = type(self.key)
        bit = dr.arange(uint_t, dr.width(self.corners)) & 7
        return dr.block_reduce(dr.ReduceOp.Or, dr.select(condition, uint_t(1) << bit, 0), 8)


class CubeExtraction(MarchingExtraction[_Polygons]):
    """Marching cubes."""

    EDGE_DIFFERENCES = 0b00010110

    def polygons(self, cells: ActiveCells, record: UInt32) -> _Polygons:
        masks = self.uint_t(tables.polygon_mask_table())
        mask = dr.gather(self.uint_t, masks, cells.signs, cells.border == 0)
        owner, number = expand(mask, 2)
        if dr.width(owner) == 0:
            return _Polygons(owner, owner, owner)
        key = dr.gather(self.uint_t, cells.signs, owner) << 2 | number
        base = dr.gather(self.uint_t, cells.cell, owner)
        dr.eval(key, base)

        slot = dr.arange(self.uint_t, 8 * dr.width(key))
        polygon = slot >> 3
        entry = dr.gather(self.uint_t, key, polygon) << 3 | slot & 7
        edge = dr.gather(self.uint_t, self.uint_t(tables.edge_table()), entry)
        exists = edge != 0
        corners = self.edge_vertex(record, dr.gather(self.uint_t, base, polygon), edge, exists)
        corners = dr.select(exists, corners, 0)
        size = dr.popcnt(_Polygons(key, key, corners).mask(exists))
        dr.eval(corners, size)
        return _Polygons(key, size, corners)

    def triangulate(self, polygons: _Polygons) -> Array3u:
        if dr.width(polygons.key) == 0:
            return dr.zeros(self.faces_t, 0)
        return self.triangles(polygons, (self.uint_t(1) << polygons.size) - 1, polygons.corners, 3)

    def triangles(self, polygons: _Polygons, kept: UInt32, local: UInt32, log2_slots: int) -> Array3u:
        """The triangles of what is kept of polygons.

        Args:
            kept: per polygon, bit i tells that vertex i is kept.
            local: the mesh vertices of the polygons' local points; 2^log2_slots slots per polygon, 8 for
                its own vertices, 16 if there are cuts.
        """
        begins, rows, packed = (self.uint_t(table) for table in tables.clip_tables())
        row = dr.gather(self.uint_t, rows, dr.gather(self.uint_t, begins, polygons.key) + kept)
        dr.eval(row)
        polygon, triangle = expand((self.uint_t(1) << (row & 7)) - 1, 3)
        if dr.width(polygon) == 0:
            return dr.zeros(self.faces_t, 0)
        points = dr.gather(self.uint_t, packed, (dr.gather(self.uint_t, row, polygon) >> 3) + triangle)
        first = polygon << log2_slots
        corner = [dr.gather(self.uint_t, local, first + (points >> 4 * i & 15)) for i in range(3)]
        faces = self.faces_t(*corner)
        dr.eval(faces)
        return faces

    def clip(
        self, polygons: _Polygons, record: UInt32, count: int, kept_count: int
    ) -> tuple[Array3u, UInt32, UInt32]:
        none = dr.zeros(self.uint_t, 0)
        if dr.width(polygons.key) == 0:
            return dr.zeros(self.faces_t, 0), none, none
        kept_opaque = dr.opaque(self.uint_t, kept_count)
        _, exists = polygons.slots()
        kept = polygons.mask(exists & (polygons.corners < kept_opaque))
        all_kept = (self.uint_t(1) << polygons.size) - 1
        dr.eval(kept, all_kept)
        whole, mixed = dr.compress(kept == all_kept), dr.compress((kept != 0) & (kept != all_kept))
        faces = self.triangulate(polygons.at(whole) if dr.width(whole) else _Polygons(none, none, none))
        if dr.width(mixed) == 0:
            return faces, none, none

        polygons = polygons.at(mixed)
        kept = dr.gather(self.uint_t, kept, mixed)
        polygon, exists = polygons.slots()
        slot = dr.arange(self.uint_t, dr.width(polygons.corners))
        entry = dr.gather(self.uint_t, polygons.key, polygon) << 3 | slot & 7
        side = dr.gather(self.uint_t, self.uint_t(tables.side_table()), entry)
        this, following = polygons.corners, dr.gather(self.uint_t, polygons.corners, polygon << 3 | side >> 4)
        stays = this < kept_opaque
        cut = exists & (stays != (following < kept_opaque))
        owner = dr.minimum(this, following)
        kind = dr.select(this < following, side & 3, side >> 2 & 3)
        dr.eval(cut, owner, kind)

        cut_sides = dr.zeros(self.uint_t, count)  # per mesh vertex: bits of the sides that are cut
        dr.scatter_reduce(dr.ReduceOp.Or, cut_sides, self.uint_t(1) << kind, owner, cut, dr.ReduceMode.Local)
        before = dr.prefix_reduce(dr.ReduceOp.Add, dr.popcnt(cut_sides))
        cut_count = dr.sum(dr.popcnt(cut_sides))[0]

        below = dr.gather(self.uint_t, cut_sides, owner, cut) & ((self.uint_t(1) << kind) - 1)
        cut_vertex = dr.gather(self.uint_t, before, owner, cut) + dr.popcnt(below)
        starts, ends = dr.empty(self.uint_t, cut_count), dr.empty(self.uint_t, cut_count)
        # Both polygons at a face write the same values.
        dr.scatter(starts, dr.minimum(this, following), cut_vertex, cut, dr.ReduceMode.Permute)
        dr.scatter(ends, dr.maximum(this, following) - kept_opaque, cut_vertex, cut, dr.ReduceMode.Permute)
        local = dr.empty(self.uint_t, 16 * dr.width(mixed))
        dr.scatter(local, this, polygon << 4 | slot & 7, slot & 7 != 7, dr.ReduceMode.Permute)
        dr.scatter(local, kept_opaque + cut_vertex, (polygon << 4 | slot & 7) + 7, cut, dr.ReduceMode.Permute)
        dr.eval(starts, ends, local)
        clipped = self.triangles(polygons, kept, local, 4)
        if dr.width(faces) == 0:
            return clipped, starts, ends
        return concatenate([faces, clipped]), starts, ends
