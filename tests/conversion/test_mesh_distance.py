import numpy as np
import pytest
import trimesh

from gshell_mi.conversion.mesh_distance import MeshFeet, nearest_faces
from gshell_mi.lattice import TetLattice


@pytest.fixture(scope="module")
def sheet():
    """Four triangles in the plane z = 0.1, and two that stand on one side of it."""
    vertices = [
        [-0.5, -0.5, 0.1],
        [0.5, -0.5, 0.1],
        [0.5, 0.5, 0.1],
        [-0.5, 0.5, 0.1],
        [0, 0, 0.1],
        [0.5, -0.5, 0.6],
        [0.5, 0.5, 0.6],
    ]
    faces = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 5, 2], [2, 5, 6]]
    return trimesh.Trimesh(vertices, faces, process=False)


def test_nearest_faces_against_all(sheet):
    lattice, reach = TetLattice(12), 0.4
    vertex, face = nearest_faces(sheet, lattice, reach)
    p = lattice.vertex_positions().astype(float)
    all_distances = np.stack(
        [
            np.linalg.norm(p - trimesh.triangles.closest_point(np.repeat(t[None], len(p), axis=0), p), axis=1)
            for t in sheet.triangles
        ]
    )
    least = all_distances.min(axis=0)
    clear = np.abs(least - reach) > 1e-4
    np.testing.assert_array_equal(np.isin(np.arange(len(p)), vertex)[clear], (least < reach)[clear])
    np.testing.assert_allclose(all_distances[face, vertex], least[vertex], atol=1e-4)


def test_feet(sheet):
    feet_of = MeshFeet(sheet)
    points = np.array([[0.1, -0.3, 0.3], [-0.7, 0.0, 0.1], [0.6, 0.0, 0.0], [0.0, 0.0, -0.2]])
    feet = feet_of(points, np.tile(np.arange(6), (4, 1)))
    np.testing.assert_allclose(feet.point, [[0.1, -0.3, 0.1], [-0.5, 0, 0.1], [0.5, 0, 0.1], [0, 0, 0.1]])
    np.testing.assert_allclose(feet.distance, [0.2, 0.2, np.hypot(0.1, 0.1), 0.3])
    # Over a face, past a rim in its plane, beside the crease (its normal is the mean of both), at a vertex.
    np.testing.assert_array_equal(feet.on_rim, [False, True, False, False])
    diagonal = np.array([-1, 0, 1]) / np.sqrt(2)
    np.testing.assert_allclose(feet.normal, [[0, 0, 1], [0, 0, 1], diagonal, [0, 0, 1]], atol=1e-9)
    np.testing.assert_allclose(feet.height, [0.2, 0, -np.hypot(0.1, 0.1), -0.3], atol=1e-9)


def test_rim_samples(sheet):
    samples, loop = MeshFeet(sheet).rim_samples(0.05)
    assert len(loop) == len(samples)
    assert len(np.unique(loop)) == 1
    on_bottom = np.isclose(samples[:, 2], 0.1)
    assert np.abs(samples[on_bottom][:, :2]).max(axis=1) == pytest.approx(0.5)
    order = samples[np.isclose(samples[:, 0], -0.5)][:, 1]
    assert np.diff(np.sort(order)).max() < 0.05 + 1e-9
