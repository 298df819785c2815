"""Look-up tables of marching cubes and its dual, generated from the combinatorics of the cube.

A corner of a cube is a number 0..7 whose bits 0, 1, 2 are its x, y, z; an edge is its lowest corner and its
axis; a face is its axis and its side (0 low, 1 high), numbered ``2 axis + side``. The isosurface crosses
the edges whose corners have different signs. In every face the crossings are joined in pairs by segments,
and the segments of all six faces close into loops, the isosurface polygons.

A face with four crossings is ambiguous. The rule is to cut the two inside corners off, one by one. It
reads the signs of the face alone, so both cubes at the face agree and no crack can open.
"""

from dataclasses import dataclass
from functools import cache
from math import inf

import numpy as np

Edge = tuple[int, int]  # lowest corner, axis

EDGES: tuple[Edge, ...] = tuple((c, axis) for axis in range(3) for c in range(8) if not c >> axis & 1)


@dataclass(frozen=True)
class Polygon:
    """A loop of crossed edges, anticlockwise seen from outside."""

    edges: tuple[Edge, ...]
    """Its vertices."""
    faces: tuple[int, ...]
    """The face that holds the side from each vertex to the next."""

    def holds(self, point: int) -> set[int]:
        """The faces that hold a local point: vertex i, or for 7 + i the cut on the side after vertex i."""
        return {self.faces[point - 7]} if point >= 7 else {self.faces[point], self.faces[point - 1]}


def face_corners(face: int) -> list[int]:
    """Corners of a face, anticlockwise seen from outside the cube."""
    axis, side = divmod(face, 2)
    u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
    corners = [0, u, u | v, v] if side else [0, v, u | v, u]
    return [c | side << axis for c in corners]


def face_segments(face: int, signs: int, joined: bool) -> list[tuple[Edge, Edge]]:
    """The directed segments of a face, with the inside to their left seen from outside the cube.

    Args:
        signs: bit c tells that corner c is inside.
        joined: join the inside corners of an ambiguous face instead of cutting them off.
    """
    corners = face_corners(face)
    sides = [(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    inside = [signs >> c & 1 for c in corners]
    step = -1 if joined else 1
    segments = []
    for i in range(4):
        if not inside[i] and inside[(i + 1) % 4]:
            ends = (j % 4 for j in range(i + step, i + 4 * step, step))
            leaving = next(j for j in ends if inside[j] and not inside[(j + 1) % 4])
            segments.append((_edge(*sides[i]), _edge(*sides[leaving])))
    return segments


def _edge(a: int, b: int) -> Edge:
    return min(a, b), (a ^ b).bit_length() - 1


@cache
def cube_polygons(signs: int, joined_face: int | None = None) -> list[Polygon]:
    """The isosurface polygons of a cube, of 3 to 7 vertices; no two share a vertex.

    Args:
        signs: bit c tells that corner c is inside.
        joined_face: a face whose inside corners are joined.
    """
    following = {}
    for face in range(6):
        for start, end in face_segments(face, signs, face == joined_face):
            following[start] = (end, face)
    polygons = []
    while following:
        edges, faces = [min(following)], []
        while edges[-1] in following:
            end, face = following.pop(edges[-1])
            edges.append(end)
            faces.append(face)
        polygons.append(Polygon(tuple(edges[:-1]), tuple(faces)))
    return polygons


@cache
def twice_visited_face(signs: int) -> int | None:
    """The ambiguous face whose two segments belong to the same polygon, None if there is none.

    There is never more than one. Joining its inside corners splits the polygon into two.
    """
    faces = [f for p in cube_polygons(signs) for f in set(p.faces) if p.faces.count(f) == 2]
    return faces[0] if faces else None


def triangulate(polygon: Polygon, outline: list[int]) -> list[tuple[int, int, int]]:
    """Triangles of an outline of local points, without a diagonal in a face of the cube.

    A diagonal in a face could be drawn by the neighbouring cube too, and the edge would then have four
    triangles. As a line meets the border of a cube in more than two points only within a face, this also
    rules out that the corners of a triangle are collinear. Of the triangulations that remain, it is the
    one with the shortest diagonals when all crossings are at the middle of their edges.
    """
    points = {p: _local_position(polygon, p) for p in outline}

    @cache
    def best(first: int, last: int) -> tuple[float, tuple]:
        """Cost and triangles of the part of the outline that the diagonal from first to last cuts off."""
        if last - first < 2:
            return 0.0, ()
        a, b = outline[first], outline[last]
        cost = float(np.sum((points[a] - points[b]) ** 2))
        if last - first == len(outline) - 1:
            cost = 0.0  # a side
        elif polygon.holds(a) & polygon.holds(b):
            cost = inf
        options = []
        for middle in range(first + 1, last):
            (cost1, part1), (cost2, part2) = best(first, middle), best(middle, last)
            options.append((cost1 + cost2, (*part1, (a, outline[middle], b), *part2)))
        total, triangles = min(options)
        return cost + total, triangles

    cost, triangles = best(0, len(outline) - 1)
    assert cost < inf
    return list(triangles)


def _local_position(polygon: Polygon, point: int) -> np.ndarray:
    size = len(polygon.edges)
    ends = (point, point) if point < 7 else (point - 7, (point - 6) % size)
    return np.mean([edge_middle(polygon.edges[i]) for i in ends], axis=0)


def edge_middle(edge: Edge) -> np.ndarray:
    """Middle of an edge of the unit cube."""
    corner, axis = edge
    position = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1], float)
    position[axis] = 0.5
    return position


def clip(polygon: Polygon, kept: int) -> list[tuple[int, int, int]]:
    """Triangles of the part of a polygon that is kept when vertices are cut off.

    Args:
        kept: bit i tells that vertex i stays.

    Returns:
        Triangles over the local points 0..6 (the polygon's vertices) and 7..13 (the cut on the side from
        vertex i - 7 to the next). Vertices that stay but are not neighbours are kept apart; whatever were
        chosen there, cut vertices lie in faces of cubes, where both neighbours see the same one.
    """
    size = len(polygon.edges)
    stays = [bool(kept >> i & 1) for i in range(size)]
    if all(stays):
        return triangulate(polygon, list(range(size)))
    triangles = []
    for start in (i for i in range(size) if stays[i] and not stays[i - 1]):
        outline = [7 + (start - 1) % size]
        while stays[start]:
            outline.append(start)
            start = (start + 1) % size
        outline.append(7 + (start - 1) % size)
        triangles += triangulate(polygon, outline)
    return triangles


def faces_around_edge(edge: Edge, face: int) -> int:
    """Number 0..3 of a face among the four lattice faces around one of its edges.

    The faces extend along the two other axes, either way: bit 1 tells the axis, bit 0 the way.
    """
    corner, axis = edge
    along = next(a for a in range(3) if a not in (axis, face // 2))
    return ((along - axis - 1) % 3) << 1 | (corner >> along & 1)


def cube_around_edge(edge: Edge) -> int:
    """Number 0..3 of the cube among the four around one of its edges: the bits of the edge in the cube."""
    corner, axis = edge
    return (corner >> (axis + 1) % 3 & 1) | (corner >> (axis + 2) % 3 & 1) << 1


# Packed tables. ``case`` is ``signs``, + 256 if the inside corners of the twice visited face are joined. A
# polygon's entry is 4 * case + its number among those of its cube.

CASES = 512


def _pack(values: list[int], bits: int) -> int:
    return sum(v << bits * i for i, v in enumerate(values))


@cache
def _case_polygons() -> list[list[Polygon]]:
    split = [cube_polygons(signs, twice_visited_face(signs)) for signs in range(256)]
    return [*(cube_polygons(signs) for signs in range(256)), *split]


def polygon_entries() -> list[tuple[int, Polygon]]:
    """All polygons with their entries."""
    return [(4 * case + i, p) for case, found in enumerate(_case_polygons()) for i, p in enumerate(found)]


@cache
def polygon_mask_table() -> np.ndarray:
    """``[case]``: bit i tells that the cube has a polygon i."""
    return np.array([(1 << len(polygons)) - 1 for polygons in _case_polygons()], np.uint32)


@cache
def edge_table() -> np.ndarray:
    """``[8 * entry + i]``: edge of vertex i as corner << 3 | difference of its ends; 0 past the last."""
    table = np.zeros((4 * CASES, 8), np.uint32)
    for entry, polygon in polygon_entries():
        table[entry, : len(polygon.edges)] = [corner << 3 | 1 << axis for corner, axis in polygon.edges]
    return table.ravel()


@cache
def around_table() -> np.ndarray:
    """``[8 * entry + i]``: number of the cube around the edge of vertex i (bits 0-1) and of the edge in the
    cube, as in ``EDGES`` (bits 2-5)."""
    table = np.zeros((4 * CASES, 8), np.uint32)
    for entry, polygon in polygon_entries():
        table[entry, : len(polygon.edges)] = [
            cube_around_edge(edge) | EDGES.index(edge) << 2 for edge in polygon.edges
        ]
    return table.ravel()


@cache
def twice_visited_face_table() -> np.ndarray:
    """``[signs]``: ``twice_visited_face``, 7 for none."""
    faces = [twice_visited_face(signs) for signs in range(256)]
    return np.array([7 if face is None else face for face in faces], np.uint32)


@cache
def side_table() -> np.ndarray:
    """``[8 * entry + i]``: the side after vertex i. Bits 0-1 and 2-3: the number of its face around the
    edges of its first and its second vertex; bits 4-6: the second vertex."""
    table = np.zeros((4 * CASES, 8), np.uint32)
    for entry, polygon in polygon_entries():
        for i, (edge, face) in enumerate(zip(polygon.edges, polygon.faces, strict=True)):
            j = (i + 1) % len(polygon.edges)
            around = [faces_around_edge(edge, face), faces_around_edge(polygon.edges[j], face)]
            table[entry, i] = _pack([*around, j], 2)
    return table.ravel()


@cache
def clip_tables() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles of what is kept of polygons.

    Returns:
        ``[entry]``: where the polygon's rows begin; ``[begin + kept]``: first << 3 | number of triangles;
        and the triangles, three local points of 4 bits each. Polygons of the same shape share their rows.
    """
    begins = np.zeros(4 * CASES, np.uint32)
    begin_of_shape: dict[tuple, int] = {}
    rows: list[int] = []
    triangles: list[int] = []
    for entry, polygon in polygon_entries():
        size = range(len(polygon.edges))
        middles = [edge_middle(edge) for edge in polygon.edges]
        distances = [float(np.sum((middles[i] - middles[j]) ** 2)) for i in size for j in size]
        shape = (*distances, *(len(polygon.holds(i) & polygon.holds(j)) for i in size for j in size))
        if shape not in begin_of_shape:
            begin_of_shape[shape] = len(rows)
            for kept in range(1 << len(size)):
                clipped = [_pack(list(t), 4) for t in clip(polygon, kept)]
                rows.append(len(triangles) << 3 | len(clipped))
                triangles += clipped
        begins[entry] = begin_of_shape[shape]
    return begins, np.array(rows, np.uint32), np.array(triangles, np.uint32)
