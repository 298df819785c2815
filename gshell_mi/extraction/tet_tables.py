"""Look-up tables of tetrahedral extraction, generated from the combinatorics of the Kuhn split.

A corner of a cell is a number 0..7 whose bits 0, 1, 2 are its x, y, z. The vertices of every simplex of
the Kuhn split form a chain of corners in which each holds the bits of the one before; moved to its lowest
corner, a simplex is known by the differences to it:

* an edge by one difference 1..7,
* a face by two, ``FACE_TYPES`` (12 of them),
* a tetrahedron is a chain ``0 < a < b < 7``, ``TETS`` (6 of them).
"""

from functools import cache
from itertools import permutations

import numpy as np

Edge = tuple[int, int]  # the corners it joins, lowest first

#: Corners of the six tetrahedra of a cell.
TETS: tuple[tuple[int, int, int, int], ...] = tuple(
    (0, 1 << a, 1 << a | 1 << b, 7) for a, b, _ in permutations(range(3))
)

#: Differences of a face's upper two vertices to its lowest.
FACE_TYPES: tuple[tuple[int, int], ...] = tuple(
    (d1, d2) for d1 in range(1, 8) for d2 in range(d1 + 1, 8) if d1 & d2 == d1
)


def corner_position(corner: int) -> np.ndarray:
    """Position of a cell's corner in the unit cube."""
    return np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1], float)


def tet_polygon(tet: int, inside: int) -> list[Edge]:
    """The isosurface polygon of a tetrahedron as the edges that its vertices lie on.

    Args:
        tet: index into ``TETS``.
        inside: bit i tells that the i-th vertex of the tetrahedron is inside.

    Returns:
        Three or four edges in cyclic order, anticlockwise seen from outside; none if all vertices lie on
        one side. Consecutive edges share a lattice vertex, i.e. the polygon's sides lie in faces.
    """
    corners = TETS[tet]
    inner = [c for i, c in enumerate(corners) if inside >> i & 1]
    outer = [c for i, c in enumerate(corners) if not inside >> i & 1]
    if not inner or not outer:
        return []
    if len(inner) == len(outer):
        (i, j), (k, m) = inner, outer
        pairs = [(i, k), (i, m), (j, m), (j, k)]
    else:
        pairs = [(i, o) for i in inner for o in outer]
    points = [(corner_position(a) + corner_position(b)) / 2 for a, b in pairs]
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    outward = np.mean([corner_position(c) for c in outer], axis=0) - np.mean(
        [corner_position(c) for c in inner], axis=0
    )
    if normal @ outward < 0:
        pairs.reverse()
    return [(min(p), max(p)) for p in pairs]


def side_face(first: Edge, second: Edge) -> tuple[int, int]:
    """The face that holds the polygon side between two edges, as (lowest corner, face type)."""
    low, mid, high = sorted({*first, *second})
    return low, FACE_TYPES.index((mid - low, high - low))


def clip_polygon(size: int, kept: int) -> list[tuple[int, int, int]]:
    """Triangles of the part of a polygon that is kept when vertices are cut off.

    Args:
        size: vertices of the polygon, 3 or 4.
        kept: bit i tells that vertex i stays.

    Returns:
        Triangles over the local indices 0..3 (the polygon's vertices) and 4..7 (the cut on the side from
        vertex i - 4 to the next). Two opposite vertices of a quad are kept apart, in two triangles;
        whatever were chosen there, cut vertices lie in faces of the lattice, where both neighbours see
        the same one, so the choice cannot open a crack or pinch the surface.
    """
    stays = [bool(kept >> i & 1) for i in range(size)]
    if size == 4 and stays in ([True, False] * 2, [False, True] * 2):
        return [(4 + (i - 1) % 4, i, 4 + i) for i in range(4) if stays[i]]
    outline = []
    for i in range(size):
        if stays[i]:
            outline.append(i)
        if stays[i] != stays[(i + 1) % size]:
            outline.append(4 + i)
    if len(outline) == 5:
        # Fan from the corner opposite the cut: the best shaped triangles of the five fans.
        apex = next(i for i in range(4) if not stays[(i + 2) % 4])
        start = outline.index(apex)
        outline = outline[start:] + outline[:start]
    return [(outline[0], outline[i], outline[i + 1]) for i in range(1, len(outline) - 1)]


def _pack(values: list[int], bits: int) -> int:
    return sum(v << bits * i for i, v in enumerate(values))


@cache
def _cell_polygons() -> list[list[list[Edge]]]:
    """``tet_polygon`` for every tetrahedron and every combination of inside corners of its cell."""
    return [
        [tet_polygon(tet, _pack([signs >> c & 1 for c in corners], 1)) for signs in range(256)]
        for tet, corners in enumerate(TETS)
    ]


@cache
def active_tets_table() -> np.ndarray:
    """``[signs]``: bit i tells that the surface passes through tetrahedron i; ``signs`` has bit c set if
    corner c of the cell is inside."""
    polygons = _cell_polygons()
    return np.array([_pack([bool(p[signs]) for p in polygons], 1) for signs in range(256)], np.uint32)


@cache
def polygon_table() -> np.ndarray:
    """``[tet * 256 + signs]``: four edges of 6 bits (corner << 3 | difference); bit 24: it is a quad."""
    return np.array(
        [
            _pack([low << 3 | high - low for low, high in edges], 6) | (len(edges) == 4) << 24
            for tet in _cell_polygons()
            for edges in tet
        ],
        np.uint32,
    )


@cache
def side_table() -> np.ndarray:
    """``[tet * 256 + signs]``: faces that hold the polygon's sides, 7 bits each (corner << 4 | type)."""
    return np.array(
        [
            _pack([low << 4 | kind for low, kind in map(side_face, edges, edges[1:] + edges[:1])], 7)
            for tet in _cell_polygons()
            for edges in tet
        ],
        np.uint32,
    )


@cache
def clip_table() -> np.ndarray:
    """``[quad * 16 + kept]``: up to three triangles of three 3-bit local indices; bits 27-28: how many."""
    table = np.zeros(2 * 16, np.uint32)
    for quad in range(2):
        for kept in range(16):
            triangles = clip_polygon(3 + quad, kept) if kept >> (3 + quad) == 0 else []
            table[quad * 16 + kept] = _pack([i for t in triangles for i in t], 3) | len(triangles) << 27
    return table
