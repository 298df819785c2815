"""The checkers must object to every defect that they are there for."""

import numpy as np
import pytest
from topology import assert_manifold, component_count, euler_characteristic, loop_count

QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)


def test_accepts_a_quad():
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    assert_manifold(QUAD, faces)
    assert (loop_count(faces), component_count(faces), euler_characteristic(faces)) == (1, 1, 1)


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        ([[0, 1, 2]], "unreferenced"),
        ([[0, 1, 2], [0, 2, 3], [1, 2, 0]], "duplicate"),
        ([[0, 1, 2], [0, 3, 2]], "twice"),
    ],
)
def test_rejects(faces, message):
    with pytest.raises(AssertionError, match=message):
        assert_manifold(QUAD, np.array(faces))


def test_rejects_degenerate_faces():
    with pytest.raises(AssertionError, match="zero-area"):
        assert_manifold(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], float), np.array([[0, 1, 2]]))


def test_rejects_pinched_boundary_vertex():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0]], float)
    with pytest.raises(AssertionError, match="boundary vertex"):
        assert_manifold(vertices, np.array([[0, 1, 2], [0, 3, 4]]))


def test_rejects_pinched_interior_vertex():
    base = np.array([[1, 0, 1], [0, 1, 1], [-1, -1, 1]], float)
    vertices = np.concatenate([[[0, 0, 0]], base, -base])
    cone = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [3, 2, 1]]
    faces = np.array(cone + [[i + 3 if i else 0 for i in f[::-1]] for f in cone])
    with pytest.raises(AssertionError, match="fans"):
        assert_manifold(vertices, faces)
