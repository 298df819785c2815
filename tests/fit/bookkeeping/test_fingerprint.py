import json
from dataclasses import replace

import numpy as np
import pytest

from gshell_mi import UserError
from gshell_mi.fields import sphere
from gshell_mi.fit.bookkeeping.fingerprint import check_fingerprint, fingerprint
from gshell_mi.lattice import TetLattice
from gshell_mi.scene import load_fit_scene


@pytest.fixture(scope="module")
def found(bowl_scene) -> dict:
    return fingerprint(load_fit_scene(bowl_scene), TetLattice(20))


def test_the_same_scene_has_the_same(bowl_scene, found):
    again = fingerprint(load_fit_scene(bowl_scene), TetLattice(20))
    assert again == found and len(found["views"]) == len(found["targets"]) == 12
    check_fingerprint(json.loads(json.dumps(again)), found)


def test_given_fields_belong_to_it(bowl_scene, tmp_path):
    found = []
    for radius in (0.5, 0.6):
        ball = sphere(TetLattice(20), radius)
        np.savez(tmp_path / "ball.npz", sdf=ball.sdf)
        scene = tmp_path / "ball.xml"
        scene.write_text(
            bowl_scene.read_text().replace(
                '<integer name="resolution" value="20"/>', '<string name="filename" value="ball.npz"/>'
            )
        )
        found.append(fingerprint(load_fit_scene(scene, bowl_scene.with_suffix("")), TetLattice(20)))
    assert found[0] != found[1]
    assert found[0] | {"fields": ""} == found[1] | {"fields": ""}
    with pytest.raises(UserError, match=r"other inputs \(fields of the gshell shape\); resume with the same"):
        check_fingerprint(*found)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lattice": "tet, 24 cells"}, "(lattice: tet, 24 cells instead of tet, 20 cells); resume with"),
        ({"light": "x", "material": "y"}, "(material of the gshell shape, initial light); resume"),
        ({"targets": {}}, "(images of 'view_000', 'view_001', 'view_002' ...); resume"),
        ({"views": {}}, "(0 views instead of 12: "),
    ],
)
def test_it_says_what_differs(found, changes, words):
    with pytest.raises(UserError) as told:
        check_fingerprint(found | changes, found)
    assert words in str(told.value)


def test_a_crafted_one_without_entries(found):
    with pytest.raises(UserError, match="lattice: None instead of tet"):
        check_fingerprint({}, found)


def test_pixels_known_in_part_belong_to_it(bowl_scene, found):
    scene = load_fit_scene(bowl_scene)
    first, *others = scene.targets
    first = replace(first, known=np.full(first.rgba.shape[:2], 0.3, np.float32))
    other = fingerprint(replace(scene, targets=[first, *others]), TetLattice(20))
    differ = [name for name, digest in other["targets"].items() if digest != found["targets"][name]]
    assert differ == [scene.sensors[0].id()]
