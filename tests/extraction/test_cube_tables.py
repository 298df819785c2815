from itertools import combinations

import numpy as np
import pytest

from gshell_mi.extraction import cube_tables as tables

SIGNS = range(256)


def _inside(signs, corner):
    return bool(signs >> corner & 1)


@pytest.mark.parametrize("signs", SIGNS)
def test_polygons_cross_each_crossed_edge_once(signs):
    crossed = {(c, a) for c, a in tables.EDGES if _inside(signs, c) != _inside(signs, c | 1 << a)}
    polygons = tables.cube_polygons(signs)
    edges = [e for p in polygons for e in p.edges]
    assert len(edges) == len(set(edges)) and set(edges) == crossed
    for polygon in polygons:
        assert 3 <= len(polygon.edges) <= 7
        for i, face in enumerate(polygon.faces):
            corners = set(tables.face_corners(face))
            for corner, axis in (polygon.edges[i], polygon.edges[(i + 1) % len(polygon.edges)]):
                assert {corner, corner | 1 << axis} <= corners, "a side lies in a face"


@pytest.mark.parametrize("axis", range(3))
def test_neighbours_agree_at_their_face(axis):
    """The segments of a face are those of the opposite face of the neighbour, reversed."""
    low, high = 2 * axis, 2 * axis + 1
    for signs in SIGNS:
        corners = tables.face_corners(high)
        if signs & ~sum(1 << c for c in corners):
            continue  # the segments depend on the face alone
        mirrored = sum(1 << (c ^ 1 << axis) for c in corners if _inside(signs, c))
        here = set(tables.face_segments(high, signs, joined=False))
        there = tables.face_segments(low, mirrored, joined=False)
        assert here == {tuple((c | 1 << axis, a) for c, a in (end, start)) for start, end in there}


def test_polygons_face_the_outside():
    """The polygon around a single inside corner is anticlockwise seen from outside, in every rotation."""
    for corner in range(8):
        (polygon,) = tables.cube_polygons(1 << corner)
        p = np.array([tables.edge_middle(e) for e in polygon.edges])
        outward = 0.5 - np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
        assert np.cross(p[1] - p[0], p[2] - p[0]) @ outward > 0


def test_ambiguous_faces_cut_the_inside_corners_off():
    diagonal = 0b00001001  # corners 0 and 3 of the face z = 0
    assert sorted(len(p.edges) for p in tables.cube_polygons(diagonal)) == [3, 3]
    assert [len(p.edges) for p in tables.cube_polygons(diagonal, joined_face=4)] == [6]


@pytest.mark.parametrize("signs", SIGNS)
def test_joining_a_twice_visited_face_splits_its_polygon(signs):
    twice = [f for p in tables.cube_polygons(signs) for f in range(6) if p.faces.count(f) == 2]
    assert len(twice) <= 1
    face = tables.twice_visited_face(signs)
    assert twice == ([] if face is None else [face])
    if face is not None:
        polygons = tables.cube_polygons(signs, face)
        assert len(polygons) == len(tables.cube_polygons(signs)) + 1
        assert all(p.faces.count(f) < 2 for p in polygons for f in range(6))


def _shapes():
    """A polygon of every shape."""
    begins = tables.clip_tables()[0]
    return list({begins[entry]: polygon for entry, polygon in tables.polygon_entries()}.values())


@pytest.mark.parametrize("polygon", _shapes(), ids=lambda p: f"{len(p.edges)}-gon")
def test_clipped_polygon(polygon):
    size = len(polygon.edges)
    for kept in range(1 << size):
        triangles = tables.clip(polygon, kept)
        stays = [kept >> i & 1 for i in range(size)]
        cuts = {7 + i for i in range(size) if stays[i] != stays[(i + 1) % size]}
        assert {i for t in triangles for i in t} == {i for i in range(size) if stays[i]} | cuts
        directed = [e for t in triangles for e in zip(t, t[1:] + t[:1], strict=True)]
        assert len(set(directed)) == len(directed)
        boundary = {e for e in directed if e[::-1] not in directed}
        for a, b in set(directed) - boundary:
            assert not polygon.holds(a) & polygon.holds(b), "no diagonal lies in a face"
        for i in range(size):
            j = (i + 1) % size
            forward = {(1, 1): (i, j), (1, 0): (i, 7 + i), (0, 1): (7 + i, j)}.get((stays[i], stays[j]))
            assert forward is None or forward in boundary
            boundary.discard(forward)
        assert len(boundary) == len(cuts) // 2  # the rest are the cuts
        assert {v for e in boundary for v in e} == cuts


def test_faces_around_an_edge_are_told_apart():
    """Over all cubes around an edge its four faces have four numbers, and so have the cubes."""
    for axis in range(3):
        faces, cubes = {}, set()
        for corner in (c for c in range(8) if not c >> axis & 1):
            cubes.add(tables.cube_around_edge((corner, axis)))
            for face in range(6):
                if {corner, corner | 1 << axis} <= set(tables.face_corners(face)):
                    # The way the face extends from the edge, which tells it from the three others.
                    along = next(a for a in range(3) if a not in (axis, face // 2))
                    way = (along, corner >> along & 1)
                    faces.setdefault(tables.faces_around_edge((corner, axis), face), set()).add(way)
        assert cubes == set(range(4)) and set(faces) == set(range(4))
        assert all(len(ways) == 1 for ways in faces.values())
        assert all(not a & b for a, b in combinations(faces.values(), 2))


def test_packed_tables():
    entry = 4 * 0b00000001
    assert sorted(tables.edge_table()[8 * entry : 8 * entry + 8]) == [0, 0, 0, 0, 0, 1, 2, 4]
    assert [s >> 4 for s in tables.side_table()[8 * entry : 8 * entry + 3]] == [1, 2, 0]
    assert tables.polygon_mask_table()[0] == 0 and tables.polygon_mask_table()[0b10000001] == 3
    begins, rows, triangles = tables.clip_tables()
    row = rows[begins[entry] + 0b111]
    assert row & 7 == 1 and sorted(triangles[row >> 3] >> 4 * i & 15 for i in range(3)) == [0, 1, 2]
