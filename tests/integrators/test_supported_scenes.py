"""What is said of scenes whose derivatives leave something out."""

import mitsuba as mi
import numpy as np
import trimesh

from gshell_mi.compat import triangle_mesh
from gshell_mi.integrators.supported_scenes import repeated_faces, warn_once

BALL = trimesh.creation.icosphere(1)


def mesh(faces, name="ball"):
    made = triangle_mesh(name, BALL.vertices, faces)
    made.set_id(name)
    return made


def test_repeated_faces_are_counted_on_either_side():
    assert repeated_faces([mesh(BALL.faces)]) == []
    twice = np.concatenate([BALL.faces, BALL.faces[:3], BALL.faces[3:5, ::-1]])
    (sentence,) = repeated_faces([mesh(BALL.faces, "good"), mesh(twice)])
    assert sentence.startswith("Mesh 'ball' has 5 repeated faces: ")


def test_the_padding_of_a_gshell_is_no_face():
    scene = mi.load_dict({"type": "scene", "subject": {"type": "gshell", "resolution": 8}})
    assert repeated_faces(scene.shapes()) == []


def test_it_is_said_once(recwarn):
    scene = mi.load_dict({"type": "scene", "ball": mesh(np.concatenate([BALL.faces, BALL.faces]))})
    said = set()
    for _ in range(3):
        warn_once(scene, said)
    assert [str(warning.message)[:23] for warning in recwarn] == ["Mesh 'ball' has 80 repe"]
