import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes
from topology import assert_manifold, boundary_edges

from gshell_mi.extraction import extract
from gshell_mi.lattice import CubeLattice, TetLattice


def _blobs(lattice, seed=1):
    """A smooth field with several components and saddles, positive at the border."""
    p = lattice.vertex_positions()
    phase = np.random.default_rng(seed).uniform(0, 6, 3)
    waves = np.sin(5 * p + phase).sum(axis=1)
    return np.maximum(waves, 8 * (np.abs(p).max(axis=1) - 0.9)).astype(np.float32)


def test_vertices_are_those_of_marching_cubes():
    lattice = CubeLattice(24)
    sdf = _blobs(lattice)
    vertices, faces, _ = extract(lattice, mi.Float(sdf)).to_numpy()
    expected, expected_faces, *_ = marching_cubes(sdf.reshape((lattice.stride,) * 3), 0.0)
    expected = expected[:, ::-1] * lattice.spacing - 1  # z, y, x in cells
    assert len(vertices) == len(expected)
    for a, b in ((vertices, expected), (expected, vertices)):
        # Ours stay off the ends of the edges by a margin.
        assert cKDTree(a).query(b)[0].max() < 0.01 * lattice.spacing
    assert len(faces) == len(expected_faces)


@pytest.mark.parametrize("corner", range(8))
def test_single_cell_with_one_corner_inside(corner):
    sdf = np.ones(8, np.float32)
    sdf[corner] = -1
    vertices, faces, _ = extract(CubeLattice(1), mi.Float(sdf)).to_numpy()
    assert_manifold(vertices, faces)
    assert len(vertices) == 3 and len(faces) == 1


def test_two_cubes_whose_common_face_is_visited_twice_by_both():
    """The configuration in which diagonals in faces would give an edge four triangles."""
    from gshell_mi.extraction.cube_tables import cube_polygons, twice_visited_face

    found = 0
    for signs in range(256):
        if twice_visited_face(signs) != 1:  # the face x = 1
            continue
        # The mirror image at that face, in a lattice of two cubes padded by outside vertices.
        sdf = np.ones((3, 3, 3), np.float32)
        for corner in range(8):
            if signs >> corner & 1:
                x, y, z = corner & 1, corner >> 1 & 1, corner >> 2 & 1
                sdf[z, y, x] = sdf[z, y, 2 - x] = -1
        vertices, faces, _ = extract(CubeLattice(2), mi.Float(sdf.ravel())).to_numpy()
        assert_manifold(vertices, faces)
        assert len(cube_polygons(signs)[0].edges) >= 6
        found += 1
    assert found == 6


def test_fewer_vertices_than_tetrahedra_for_the_same_surface():
    sdf = mi.Float(_blobs(TetLattice(32)))
    cubes, tets = (extract(kind(32), sdf) for kind in (CubeLattice, TetLattice))
    assert 2.5 < tets.vertex_count / cubes.vertex_count < 4
    assert cubes.to_trimesh().volume == pytest.approx(tets.to_trimesh().volume, rel=0.02)


def test_rim_follows_the_faces_of_the_lattice():
    """Cut vertices lie in faces of cubes, one coordinate being a multiple of the spacing."""
    lattice = CubeLattice(16)
    p = lattice.points(mi.Float)
    mesh = extract(lattice, mi.Float(np.linalg.norm(lattice.vertex_positions(), axis=1) - 0.6), 0.1 - p.z)
    vertices, faces, _ = mesh.to_numpy()
    rim = np.unique(boundary_edges(faces))
    assert (rim >= mesh.kept_vertex_count).all() and len(rim) == mesh.vertex_count - mesh.kept_vertex_count
    cells = (vertices[rim] + 1) / lattice.spacing
    assert (np.abs(cells - np.round(cells)).min(axis=1) < 1e-4).all()
