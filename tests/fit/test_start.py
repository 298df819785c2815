"""Which lattice a fit works on."""

import mitsuba as mi
import pytest

from gshell_mi.fields import sphere
from gshell_mi.fit import FitConfig
from gshell_mi.fit.lattices import last_lattice
from gshell_mi.lattice import CubeLattice, FlexiCubesLattice, TetLattice


@pytest.mark.parametrize(
    ("shape", "settings", "expected"),
    [
        ({}, {}, FlexiCubesLattice(12)),
        ({"grid": "tet"}, {}, TetLattice(12)),
        ({"grid": "tet"}, {"grid": "cube"}, CubeLattice(12)),
        ({}, {"resolution": 16}, FlexiCubesLattice(16)),
    ],
)
def test_what_the_scene_leaves_open_is_chosen(shape, settings, expected):
    subject = mi.load_dict({"type": "gshell", "resolution": 12, **shape})
    assert last_lattice(subject, FitConfig(**settings)) == expected


def test_given_fields_keep_their_lattice(tmp_path):
    sphere(TetLattice(12)).save(tmp_path / "fields.npz")
    subject = mi.load_dict({"type": "gshell", "filename": str(tmp_path / "fields.npz")})
    assert last_lattice(subject, FitConfig()) == TetLattice(12)
