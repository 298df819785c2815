"""Meshes as they come out of files: repeated, turned or broken faces."""

import numpy as np
import pytest
import trimesh

from gshell_mi.conversion.loaded_mesh import loaded_mesh
from gshell_mi.errors import UserError

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
BOWL = trimesh.Trimesh(BALL.vertices, BALL.faces[BALL.triangles_center[:, 1] < 0.1], process=False)


def mesh(faces, vertices=BALL.vertices):
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.mark.parametrize("twice", [BOWL.faces, BOWL.faces[:, ::-1], np.roll(BOWL.faces, 1, axis=1)])
def test_repeated_faces_count_once(twice):
    found = loaded_mesh(mesh(np.concatenate([BOWL.faces, twice])), "mesh")
    assert len(found.faces) == len(BOWL.faces)
    assert found.area == pytest.approx(BOWL.area)
    assert found.is_winding_consistent


@pytest.mark.parametrize("whole", [BALL, BOWL], ids=["closed", "open"])
def test_faces_that_look_the_other_way_are_turned(whole):
    """A third of them, at random: the rest says how the piece looks."""
    faces = whole.faces.copy()
    turned = np.random.default_rng(0).random(len(faces)) < 0.3
    faces[turned] = faces[turned, ::-1]
    found = loaded_mesh(mesh(faces), "mesh")
    assert found.is_winding_consistent
    outwards = (found.face_normals * found.triangles_center).sum(axis=1)
    assert (outwards > 0).all()


def test_units_do_not_matter():
    """Faces of an object in units of 1e-9 are not taken for degenerate."""
    tiny = mesh(BOWL.faces, 1e-9 * BALL.vertices)
    found = loaded_mesh(tiny, "mesh", np.diag([1e-9, 1e-9, 1e-9, 1]))
    assert len(found.faces) == len(BOWL.faces)
    assert found.area == pytest.approx(BOWL.area)


@pytest.mark.parametrize("size", [1e-7, 1e6])
def test_a_mesh_in_its_own_units_is_welded_by_its_size(size):
    """Each face has its own vertices, which agree in nine digits."""
    soup = BOWL.triangles.reshape(-1, 3)
    soup = size * (soup + 1e-9 * np.random.default_rng(0).uniform(-1, 1, soup.shape))
    found = loaded_mesh(mesh(np.arange(len(soup)).reshape(-1, 3), soup), "mesh")
    assert found.area == pytest.approx(size**2 * BOWL.area)
    assert len(found.faces) == len(BOWL.faces)
    assert len(found.vertices) < 1.05 * len(np.unique(BOWL.faces))


def test_a_mirrored_transform_keeps_the_outside():
    found = loaded_mesh(BALL, "mesh", np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert found.volume == pytest.approx(BALL.volume)


@pytest.mark.parametrize(
    "spoilt, words",
    [
        (
            mesh(BALL.faces, np.where(np.arange(len(BALL.vertices))[:, None] == 5, np.nan, BALL.vertices)),
            "vertices at NaN or infinity",
        ),
        (mesh([[0, 0, 1], [2, 3, 3]]), "no triangles with an area"),
        (mesh([[0, 1, 2]], [[0, 0, 0], [1, 1, 1], [2, 2, 2]]), "no triangles with an area"),
        (mesh(np.zeros((0, 3), int)), "no triangles"),
    ],
)
def test_meshes_without_a_surface(spoilt, words):
    with pytest.raises(UserError, match=words):
        loaded_mesh(spoilt, "mesh")


def test_vertices_that_no_face_uses_may_be_anything():
    far = np.concatenate([BALL.vertices, [[np.nan, 0, 0], [1e30, 0, 0]]])
    assert loaded_mesh(mesh(BALL.faces, far), "mesh").bounds.max() == pytest.approx(0.6, abs=0.01)


def test_faces_of_vertices_that_are_not_there(tmp_path):
    BALL.export(tmp_path / "a.off")
    text = (tmp_path / "a.off").read_text().splitlines()
    text[-1] = "3 0 1 100000"
    (tmp_path / "a.off").write_text("\n".join(text))
    with pytest.raises(UserError, match=r"a\.off: "):
        loaded_mesh(tmp_path / "a.off", "a.off")
