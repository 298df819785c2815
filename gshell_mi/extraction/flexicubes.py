"""FlexiCubes cut by the mSDF.

Dual marching cubes (Nielson 2004) with weights per cube: Shen et al., "Flexible Isosurface Extraction for
Gradient-Based Mesh Optimization", SIGGRAPH 2023. Every isosurface polygon of a cube has one vertex, a
weighted mean of the crossings (``alpha``) of its edges (``beta``), and every crossed edge a quad between the
polygons around it, split along the diagonal with the greater weight (``gamma``).

Two polygons that meet in both segments of an ambiguous face would give their vertices an edge of four faces.
There, and only there, the inside corners of the face are joined in both cubes, which splits the two polygons:
the surface is a manifold whatever the field is. The mSDF is interpolated at the vertices with the weights of
their positions and the triangles are cut where it is negative. Every side of a quad is a segment in a face of
the lattice and every diagonal belongs to an edge of it, so both triangles at a cut know it by the same name.
"""

from dataclasses import dataclass, replace

import drjit as dr

from ..arrays import Array3f, Array3u, Bool, Field, Float, UInt32
from ..lattice import BlockLattice, FlexiCubesLattice, Lattice
from ..lattice.lattice import corner_offset
from ..lattice.sign_words import expand, is_set
from . import cube_tables as tables
from .grid_extraction import ActiveCells, GridExtraction
from .surface_mesh import CutPoints, DualPoints, EdgePoints, SurfaceMesh, concatenate, gather
from .triangle_cut import cut_triangles

_WEIGHTS_PER_CUBE = 21  # alpha of its 8 corners, beta of its 12 edges, gamma

#: Crossings and cuts stay this far off the ends of their edge, as a fraction of it: where vertices come
#: closer to each other, the triangles between them may lose their area to rounding.
_MARGIN = 0.01

# A diagonal is not taken if it makes a triangle this much smaller than the other diagonal does.
_FLAT = 0.01


@dataclass(frozen=True)
class _Polygons:
    """Isosurface polygons of cubes, with one vertex each."""

    cell: UInt32  # lowest lattice vertex of the cube
    points: DualPoints
    crossing: UInt32  # the crossed edges that they go through; eight slots per polygon
    side: UInt32  # ``side_table``, per slot
    around: UInt32  # ``around_table``, per slot
    exists: Bool  # per slot: the polygon has that many vertices


class FlexiCubesExtraction(GridExtraction):
    """FlexiCubes."""

    EDGE_DIFFERENCES = 0b00010110

    def __init__(self, lattice: FlexiCubesLattice | BlockLattice, float_t: type[Float]):
        super().__init__(lattice, float_t)
        self.margin = dr.opaque(float_t, _MARGIN)

    def surface(
        self,
        cells: ActiveCells,
        sdf: Float,
        msdf: Float | None,
        deform: Field | None,
        with_template: bool,
        weights: Float | None,
    ) -> SurfaceMesh:
        a, _ = self.crossed_edges(cells)
        count = dr.width(a)
        if count == 0:
            return self.empty_mesh(with_template)
        polygons = self.polygons(cells, self.record_edges(cells), weights, sdf)
        points = polygons.points

        kept_count = points.count
        if msdf is not None:
            kept, dropped = self.kept_and_dropped(points, msdf)
            kept_count = dr.width(kept)
        if kept_count == 0 and not with_template:
            return self.empty_mesh(False)
        faces, diagonal = self.quads(cells.inside, a, polygons, weights, deform)
        if msdf is None or kept_count in (0, points.count):
            uncut = self.mesh((points,), faces, msdf, deform, kept_count)
            mesh = uncut if kept_count else self.empty_mesh(False)
            return replace(mesh, template=uncut) if with_template else mesh

        order = self.kept_first(kept, dropped)
        names = self.edge_names(count, polygons, cells.inside, a, diagonal)
        faces = self.faces_t(*(dr.gather(self.uint_t, order, corner) for corner in faces))
        dr.eval(faces)
        kept_points, dropped_points = points.at(kept), points.at(dropped)
        template = None
        if with_template:
            template = self.mesh((kept_points, dropped_points), faces, msdf, deform, kept_count)
        faces, start, end = cut_triangles(faces, names, 5 * count, kept_count)
        blocks = (kept_points,)
        if dr.width(start):
            start_points, end_points = kept_points.at(start), dropped_points.at(end)
            t = self.zero_crossing(start_points.interpolate(msdf), end_points.interpolate(msdf))
            blocks += (CutPoints(start_points, end_points, t),)
        return replace(self.mesh(blocks, faces, msdf, deform, kept_count), template=template)

    # Polygons -----------------------------------------------------------------------------------------

    def cases(self, cells: ActiveCells) -> UInt32:
        """Signs, + 256 where both cubes at an ambiguous face visit it twice."""
        faces = self.uint_t(tables.twice_visited_face_table())
        face = dr.gather(self.uint_t, faces, cells.signs, cells.border == 0)
        case = cells.signs + 0
        visited = dr.compress((face != 7) & (cells.border == 0))
        if dr.width(visited) == 0:
            return case
        if dr.width(visited) == 1:  # arrays of one element have kernels of their own
            visited = dr.gather(self.uint_t, visited, dr.zeros(self.uint_t, 2))
        face = dr.gather(self.uint_t, face, visited)
        cell = dr.gather(self.uint_t, cells.cell, visited)
        # There is a neighbour, as nothing crosses the border.
        neighbour = self.classify(cells.inside, self.neighbour(cell, face >> 1, face & 1 == 1))
        both = dr.gather(self.uint_t, faces, neighbour.signs) == face ^ 1
        signs = dr.gather(self.uint_t, cells.signs, visited)
        dr.scatter(case, signs + 256, visited, both, dr.ReduceMode.Permute)
        return case

    def polygons(self, cells: ActiveCells, record: UInt32, weights: Float | None, sdf: Float) -> _Polygons:
        case = self.cases(cells)
        masks = self.uint_t(tables.polygon_mask_table())
        owner, number = expand(dr.gather(self.uint_t, masks, case, cells.border == 0), 2)
        key = dr.gather(self.uint_t, case, owner) << 2 | number
        cell = dr.gather(self.uint_t, cells.cell, owner)
        dr.eval(key, cell)

        slot = dr.arange(self.uint_t, 8 * dr.width(key))
        polygon = slot >> 3
        entry = dr.gather(self.uint_t, key, polygon) << 3
        edges = self.uint_t(tables.edge_table())
        edge = dr.gather(self.uint_t, edges, entry | slot & 7)
        exists = edge != 0
        # Unused slots repeat the first one, with weight 0.
        entry = dr.select(exists, entry | slot & 7, entry)
        edge = dr.gather(self.uint_t, edges, entry)
        side = dr.gather(self.uint_t, self.uint_t(tables.side_table()), entry)
        around = dr.gather(self.uint_t, self.uint_t(tables.around_table()), entry)
        base = dr.gather(self.uint_t, cell, polygon)
        crossing = self.edge_vertex(record, base, edge)
        a = self.corner(base, edge >> 3)
        b = self.corner(a, edge & 7)
        dr.eval(exists, side, around, crossing, a, b)

        t = self.zero_crossing(self.value(sdf, a), self.value(sdf, b))
        weight = dr.select(exists, self.float_t(1), 0)
        if weights is not None:
            first = self.cube(base) * _WEIGHTS_PER_CUBE
            alpha_a = self.weight(weights, first + (edge >> 3))
            alpha_b = self.weight(weights, first + ((edge >> 3) | (edge & 7)))
            t = t * alpha_a / (t * alpha_a + (1 - t) * alpha_b)
            weight = dr.select(exists, self.weight(weights, first + 8 + (around >> 2)), 0)
        total = dr.block_sum(weight, 8)
        weight /= gather(self.float_t, total, polygon)
        return _Polygons(cell, DualPoints(EdgePoints(a, b, t), weight), crossing, side, around, exists)

    def value(self, sdf: Float, vertex: UInt32) -> Float:
        """The field, of which vertices on the border see nothing negative."""
        value = gather(self.float_t, sdf, vertex)
        last = self.stride - 1
        border = dr.mask_t(value)(False)
        for coordinate in self.coordinates(vertex):
            border |= (coordinate == 0) | (coordinate == last)
        return dr.select(border & (value < 0), 0, value)

    def neighbour(self, vertex: UInt32, axis: UInt32, up: Bool) -> UInt32:
        """The next vertex up or down an axis."""
        if isinstance(self.lattice, BlockLattice):
            return self.lattice.neighbour(vertex, axis, up)
        step = corner_offset(self.uint_t(1) << axis, self.stride)
        return dr.select(up, vertex + step, vertex - step)

    def cube(self, cell: UInt32) -> UInt32:
        """Number of the cube above a vertex among those that have weights."""
        if isinstance(self.lattice, BlockLattice):
            return cell
        x, y, z = self.coordinates(cell)
        side = self.stride - 1
        return x + (y + z * side) * side

    def weight(self, weights: Float, index: UInt32) -> Float:
        return positive_weight(gather(self.float_t, weights, index))

    # Quads --------------------------------------------------------------------------------------------

    def quads(
        self, inside: UInt32, a: UInt32, polygons: _Polygons, weights: Float | None, deform: Field | None
    ) -> tuple[Array3u, Bool]:
        """Two triangles per crossed edge, and whether its quad is split from the first corner on."""
        count = dr.width(a)
        slot = dr.arange(self.uint_t, dr.width(polygons.crossing))
        corner = dr.empty(self.uint_t, 4 * count)
        position = polygons.crossing << 2 | polygons.around & 3
        dr.scatter(corner, slot >> 3, position, polygons.exists, dr.ReduceMode.Permute)
        dr.eval(corner)

        quad = dr.arange(self.uint_t, count) << 2
        index = [dr.gather(self.uint_t, corner, quad + k) for k in self.turn(inside, a)]
        detached = dr.detach((polygons.points, deform))
        positions = detached[0].apply(
            lambda vertex: self.lattice.offset_positions(vertex, detached[1], self.float_t)
        )
        dr.eval(positions)
        p = [dr.gather(self.vertices_t, positions, i) for i in index]
        length = [dr.squared_norm(p[0] - p[2]), dr.squared_norm(p[1] - p[3])]
        area = [self.least_area(p), self.least_area(p[1:] + p[:1])]
        first = length[0] <= length[1]
        if weights is not None:
            cube = self.cube(polygons.cell)
            gamma = self.weight(dr.detach(weights), (cube + 1) * _WEIGHTS_PER_CUBE - 1)
            g = [dr.gather(self.float_t, gamma, i) for i in index]
            first = (g[0] * g[2] > g[1] * g[3]) | ((g[0] * g[2] == g[1] * g[3]) & first)
        first = (first & (area[0] >= _FLAT * area[1])) | (area[1] < _FLAT * area[0])
        dr.eval(first, index)
        # Corners from the diagonal's first end on: (0, 1, 2) and (2, 3, 0), or (1, 2, 3) and (3, 0, 1).
        c = [dr.select(first, index[k], index[(k + 1) % 4]) for k in range(4)]
        triangle = dr.arange(self.uint_t, 2 * count)
        upper = triangle & 1 == 1
        c = [dr.gather(self.uint_t, value, triangle >> 1) for value in c]
        faces = self.faces_t(
            dr.select(upper, c[2], c[0]), dr.select(upper, c[3], c[1]), dr.select(upper, c[0], c[2])
        )
        dr.eval(faces)
        return faces, first

    def turn(self, inside: UInt32, a: UInt32) -> list[UInt32]:
        """The numbers of the cubes around edges, anticlockwise seen from outside."""
        upwards = is_set(inside, a)
        return [
            self.uint_t(0),
            dr.select(upwards, self.uint_t(1), 2),
            self.uint_t(3),
            dr.select(upwards, self.uint_t(2), 1),
        ]

    @staticmethod
    def least_area(p: list[Array3f]) -> Float:
        """The smaller area of the triangles (0, 1, 2) and (2, 3, 0), squared."""
        return dr.minimum(
            dr.squared_norm(dr.cross(p[1] - p[0], p[2] - p[0])),
            dr.squared_norm(dr.cross(p[3] - p[2], p[0] - p[2])),
        )

    def edge_names(
        self, count: int, polygons: _Polygons, inside: UInt32, a: UInt32, diagonal: Bool
    ) -> Array3u:
        """Names of the triangles' edges: four times a crossing plus a face around it, or a diagonal's."""
        slot = dr.arange(self.uint_t, dr.width(polygons.crossing))
        following = dr.gather(self.uint_t, polygons.crossing, (slot & ~self.uint_t(7)) | polygons.side >> 4)
        ends = [polygons.crossing << 2 | polygons.side & 3, following << 2 | polygons.side >> 2 & 3]
        names = dr.empty(self.uint_t, 4 * count)
        for end in ends:  # both cubes at the face write the same
            dr.scatter(names, dr.minimum(*ends), end, polygons.exists, dr.ReduceMode.Permute)
        dr.eval(names)

        # The faces between the cubes 0 and 1, 1 and 3, 3 and 2, 2 and 0 extend along +v, -u, -v, +u.
        upwards = is_set(inside, a)
        order = [(2, 0), (1, 3), (3, 1), (0, 2)]
        quad = dr.arange(self.uint_t, count) << 2
        side = [
            dr.gather(self.uint_t, names, quad + dr.select(upwards, self.uint_t(up), down))
            for up, down in order
        ]
        side = [dr.select(diagonal, side[k], side[(k + 1) % 4]) for k in range(4)]
        dr.eval(side)
        triangle = dr.arange(self.uint_t, 2 * count)
        upper = triangle & 1 == 1
        side = [dr.gather(self.uint_t, value, triangle >> 1) for value in side]
        own = dr.opaque(self.uint_t, 4 * count) + (triangle >> 1)
        result = self.faces_t(dr.select(upper, side[2], side[0]), dr.select(upper, side[3], side[1]), own)
        dr.eval(result)
        return result


def positive_weight(weight: Float) -> Float:
    """From weights without bounds, 0 being neutral, to those of the formulas, between 0.1 and 1.9."""
    return dr.fma(dr.tanh(weight), 0.9, 1)


def deviation(mesh: SurfaceMesh, lattice: Lattice, deform: Field | None = None) -> Float:
    """The FlexiCubes regulariser (Shen et al. 2023, eq. 8), one value per vertex that is not on a cut.

    The mean absolute deviation of the distances between a vertex and the crossings that it is the mean of:
    where it is 0, the crossings lie around the vertex like on a circle.

    Args:
        mesh: extracted from a ``FlexiCubesLattice``.
        lattice, deform: those that it was extracted from.

    Returns:
        ``Float``, in lattice units; differentiable in all fields.
    """
    float_t = type(mesh.msdf)
    uint_t = dr.uint32_array_t(float_t)
    values = []
    for block in mesh.stencil.blocks if mesh.stencil else ():
        if not isinstance(block, DualPoints):
            continue
        crossings = block.edges.apply(lambda vertex: lattice.offset_positions(vertex, deform, float_t))
        polygon = dr.arange(uint_t, 8 * block.count) >> 3
        exists = dr.select(dr.detach(block.weight) > 0, float_t(1), 0)
        share = exists / gather(float_t, dr.block_sum(exists, 8), polygon)
        centre = gather(type(crossings), dr.block_sum(block.weight * crossings, 8), polygon)
        distance = dr.norm(crossings - centre)
        mean = gather(float_t, dr.block_sum(share * distance, 8), polygon)
        values.append(dr.block_sum(share * dr.abs(distance - mean), 8))
    return concatenate(values) if values else dr.zeros(float_t, 0)
