"""Where meshes go through themselves, of meshes whose answer is known."""

import numpy as np
import pytest
import trimesh

from gshell_mi.evaluation.self_intersections import piercing_edges


def of(mesh: trimesh.Trimesh) -> np.ndarray:
    return piercing_edges(np.asarray(mesh.vertices), np.asarray(mesh.faces))


@pytest.mark.parametrize(
    "mesh",
    [trimesh.creation.box(), trimesh.creation.icosphere(3), trimesh.creation.torus(1, 0.3)],
    ids=["box", "ball", "torus"],
)
def test_embedded_meshes_have_none(mesh):
    assert len(of(mesh)) == 0
    assert len(of(trimesh.util.concatenate(mesh, mesh.copy().apply_translation([5, 0, 0])))) == 0


def test_each_edge_of_a_bar_through_a_plate_is_found():
    plate = trimesh.creation.box((2, 2, 0.1))
    bar = trimesh.creation.box((0.2, 0.2, 2))
    found = of(trimesh.util.concatenate(plate, bar))
    of_plate = (found < len(plate.vertices)).all(axis=1)
    # The bar's four long edges and the diagonals of its four sides; the diagonals of the plate's two faces.
    assert ((~of_plate).sum(), of_plate.sum()) == (8, 2)


def test_a_ball_pressed_through_its_other_side():
    ball = trimesh.creation.icosphere(3)
    dented = ball.vertices.copy()
    dented[ball.vertices[:, 2] > 0.8, 2] -= 2.2
    assert len(of(trimesh.Trimesh(dented, ball.faces, process=False))) > 8


def test_what_has_no_faces_has_none():
    assert piercing_edges(np.zeros((3, 3)), np.zeros((0, 3), int)).shape == (0, 2)
