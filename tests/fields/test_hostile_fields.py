"""Archives of fields whose numbers are no fields, or no places in memory."""

import numpy as np
import pytest

from gshell_mi.errors import UserError
from gshell_mi.fields import LatticeFields, sphere
from gshell_mi.fields.mask_outline import mask_distance
from gshell_mi.lattice import TetLattice


@pytest.fixture
def archive(tmp_path):
    def write(**changes):
        sphere(TetLattice(32), in_blocks=True).save(tmp_path / "a.npz")
        with np.load(tmp_path / "a.npz") as stored:
            arrays = dict(stored)
        np.savez(
            tmp_path / "a.npz",
            **{name: changes.get(name, lambda x: x)(value) for name, value in arrays.items()},
        )
        return tmp_path / "a.npz"

    return write


def test_untouched_fields_come_back(archive):
    fields = LatticeFields.load(archive())
    assert fields.lattice.vertex_count == fields.sdf.size > 0


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"blocks": lambda x: x + 10**6}, "its blocks are not ascending whole numbers below"),
        ({"blocks": lambda x: x[::-1]}, "not ascending"),
        ({"blocks": lambda x: x * 0}, "not ascending"),
        ({"blocks": lambda x: x - 0.5}, "not ascending"),
        ({"blocks": lambda x: x[:0]}, "not ascending"),
        ({"block_resolution": lambda x: x * 0}, "no block_resolution from 1 to 800"),
        ({"block_resolution": lambda x: x + 10**6}, "no block_resolution"),
        ({"block_resolution": lambda x: np.array([8, 8])}, "no block_resolution"),
        ({"sdf": lambda x: x * np.nan}, "sdf holds NaN or infinity"),
        ({"sdf": lambda x: np.full(x.shape, "a")}, "cannot be read as an .npz archive"),
        ({"msdf": lambda x: np.full_like(x, np.inf)}, "msdf holds NaN or infinity"),
    ],
)
def test_what_is_refused(changes, words, archive):
    with pytest.raises(UserError, match=words):
        fields = LatticeFields.load(archive(**changes))
        assert fields.lattice


@pytest.mark.parametrize("mask", [np.ones((1, 1)), np.ones((1, 5)), np.ones((5, 1))])
def test_films_of_one_row(mask):
    assert (mask_distance(mask) < 0).all()
    assert (mask_distance(0 * mask) == np.inf).all()
    half = mask_distance(np.array([[0, 0, 0, 1, 1, 1.0]]))
    np.testing.assert_allclose(half[0, [0, 2, 3, 5]], [2.5, 0.5, -0.5, -2.5], atol=0.13)
