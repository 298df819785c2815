import json

import pytest

from gshell_mi import UserError
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


@pytest.mark.parametrize(("changes", "words"), [
    ({"lattice": "tet, 24 cells"}, "another lattice (tet, 24 cells instead of tet, 20 cells); resume it"),
    ({"light": "x", "material": "y"}, "another material of the gshell shape, another initial light; resume"),
    ({"targets": {}}, "another images of 'view_000', 'view_001', 'view_002' ...; resume"),
    ({"views": {}}, "another set of views (0 instead of 12"),
])
def test_it_says_what_differs(found, changes, words):
    with pytest.raises(UserError) as told:
        check_fingerprint(found | changes, found)
    assert words in str(told.value)


def test_a_crafted_one_without_entries(found):
    with pytest.raises(UserError, match="another lattice"):
        check_fingerprint({}, found)
