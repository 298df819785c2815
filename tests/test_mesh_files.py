"""Mesh files that anybody may have written."""

import numpy as np
import pytest
import trimesh

from gshell_mi.mesh_files import check_triangles, read_triangles

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_what_a_file_holds(tmp_path):
    trimesh.Trimesh(SQUARE, FACES, process=False).export(tmp_path / "a.ply")
    vertices, faces = read_triangles(tmp_path / "a.ply")
    np.testing.assert_allclose(vertices, SQUARE)
    np.testing.assert_array_equal(faces, FACES)


def test_unused_vertices_are_dropped():
    vertices, faces = check_triangles(np.concatenate([[[np.nan] * 3], SQUARE]), FACES + 1)
    np.testing.assert_array_equal(vertices, SQUARE)
    np.testing.assert_array_equal(faces, FACES)


@pytest.mark.parametrize(
    "vertices, faces, words",
    [
        (SQUARE, [[0, 1, 4]], "vertices that it lacks"),
        (SQUARE, [[0, 1, -1]], "vertices that it lacks"),
        (np.where(SQUARE == 1, np.inf, 0), FACES, "NaN or infinity"),
        (0 * SQUARE, FACES, "with an area"),
        (1e30 * SQUARE, FACES, "too far away"),
        (SQUARE[:, :2], FACES, "three coordinates"),
    ],
)
def test_what_is_refused(vertices, faces, words):
    with pytest.raises(ValueError, match=words):
        check_triangles(np.asarray(vertices, float), np.asarray(faces))
