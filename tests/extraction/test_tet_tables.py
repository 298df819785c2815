from itertools import combinations

import numpy as np
import pytest

from gshell_mi.extraction import tet_tables as tables


def test_types():
    assert len(tables.TETS) == 6 and len(tables.FACE_TYPES) == 12
    chains = {tuple(sorted(t)) for t in tables.TETS}
    assert len(chains) == 6 and all(c[0] == 0 and c[-1] == 7 for c in chains)


def test_tets_fill_the_cell():
    volume = 0
    for tet in tables.TETS:
        p = np.array([tables.corner_position(c) for c in tet])
        volume += abs(np.linalg.det(p[1:] - p[0])) / 6
    assert volume == pytest.approx(1)


def test_faces_are_shared_by_neighbouring_cells():
    # Every tetrahedron face, moved to its lowest vertex, is one of the types; over a periodic lattice
    # each type is then used by exactly two tetrahedra.
    uses = np.zeros(12, int)
    for tet in tables.TETS:
        for low, mid, high in combinations(sorted(tet), 3):
            uses[tables.FACE_TYPES.index((mid - low, high - low))] += 1
    assert (uses == 2).all()


@pytest.mark.parametrize("tet", range(6))
@pytest.mark.parametrize("inside", range(16))
def test_polygon(tet, inside):
    corners = tables.TETS[tet]
    sign = {c: inside >> i & 1 for i, c in enumerate(corners)}
    crossed = {tuple(sorted(e)) for e in combinations(corners, 2) if sign[e[0]] != sign[e[1]]}
    polygon = tables.tet_polygon(tet, inside)
    assert set(polygon) == crossed and len(polygon) == len(crossed)
    if not polygon:
        return
    points = np.array([(tables.corner_position(a) + tables.corner_position(b)) / 2 for a, b in polygon])
    for i, edge in enumerate(polygon):
        assert len({*edge, *polygon[i - 1]}) == 3, "consecutive edges lie in one face"
        normal = np.cross(points[i] - points[i - 1], points[(i + 1) % len(points)] - points[i])
        for corner in corners:  # convex, planar and facing the outside
            assert (normal @ (tables.corner_position(corner) - points[0]) < 0) == sign[corner]


@pytest.mark.parametrize("size", [3, 4])
def test_clipped_polygon(size):
    for kept in range(1 << size):
        triangles = tables.clip_polygon(size, kept)
        stays = [kept >> i & 1 for i in range(size)]
        cuts = {4 + i for i in range(size) if stays[i] != stays[(i + 1) % size]}
        used = {i for t in triangles for i in t}
        assert used == {i for i in range(size) if stays[i]} | cuts
        directed = [e for t in triangles for e in zip(t, t[1:] + t[:1], strict=True)]
        assert len(set(directed)) == len(directed)
        boundary = {e for e in directed if e[::-1] not in directed}
        # Along each side of the polygon the outline runs forwards over what is kept of it ...
        for i in range(size):
            j = (i + 1) % size
            forward = {(1, 1): (i, j), (1, 0): (i, 4 + i), (0, 1): (4 + i, j)}.get((stays[i], stays[j]))
            assert forward is None or forward in boundary
            boundary.discard(forward)
        # ... and the rest of it are the cuts, each joining two cut vertices.
        assert len(boundary) == len(cuts) // 2
        assert {v for e in boundary for v in e} == cuts


def test_packed_tables():
    entry = int(tables.polygon_table()[3 * 256 + 0b10000000])
    corners = tables.TETS[3]
    edges = [(entry >> 6 * i) & 63 for i in range(3)]
    assert entry >> 24 == 0
    assert {(e >> 3, (e >> 3) + (e & 7)) for e in edges} == {(c, 7) for c in corners[:3]}
    active = tables.active_tets_table()
    assert active[0] == active[255] == 0 and active[1] == active[128] == 63
    assert tables.clip_table()[16 + 15] >> 27 == 2 and tables.clip_table()[16 + 7] >> 27 == 3
