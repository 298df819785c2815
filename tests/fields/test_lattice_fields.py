import numpy as np
import pytest

from gshell_mi import UserError
from gshell_mi.fields import LatticeFields, sphere
from gshell_mi.lattice import GRIDS, TetLattice, make_lattice


def test_round_trip(tmp_path):
    rng = np.random.default_rng(0)
    fields = LatticeFields(*(rng.normal(size=n).astype(np.float32) for n in (27, 27, 81)))
    fields.save(tmp_path / "fields")  # under the very name that was asked for
    loaded = LatticeFields.load(tmp_path / "fields")
    for name in ("sdf", "msdf", "deform"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(fields, name))
    assert loaded.lattice == TetLattice(2)


def test_weights_of_flexicubes(tmp_path):
    weights = np.arange(21 * 8, dtype=np.float32)
    sdf, deform = np.ones(27, np.float32), np.zeros(81, np.float32)
    LatticeFields(sdf, sdf, deform, "flexicubes", weights).save(tmp_path / "a.npz")
    np.testing.assert_array_equal(LatticeFields.load(tmp_path / "a.npz", "flexicubes").weights, weights)
    assert LatticeFields.load(tmp_path / "a.npz", "cube").weights is None
    np.savez(tmp_path / "b.npz", sdf=sdf, weights=np.ones(3))
    with pytest.raises(UserError, match=r"b.npz: weights has 3 values, but sdf needs 168"):
        LatticeFields.load(tmp_path / "b.npz", "flexicubes")


@pytest.mark.parametrize("grid", GRIDS)
def test_the_grid_is_kept(grid):
    fields = sphere(make_lattice(grid, 6))
    assert fields.lattice == make_lattice(grid, 6) and fields.to_lattice(9).lattice == make_lattice(grid, 9)


def test_sdf_alone_is_closed(tmp_path):
    np.savez(tmp_path / "a.npz", sdf=np.zeros((3, 3, 3)))
    fields = LatticeFields.load(tmp_path / "a.npz")
    assert (fields.msdf == 1).all() and fields.deform.shape == (81,) and not fields.deform.any()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"msdf": np.ones(8)}, r"holds no array 'sdf' \(it has msdf\)"),
        ({"sdf": np.ones(9)}, r"sdf has 9 values, which is not \(resolution \+ 1\)\^3"),
        ({"sdf": np.ones(8), "msdf": np.ones(7)}, "msdf has 7 values, but sdf needs 8"),
        ({"sdf": np.ones(8), "deform": np.ones(8)}, "deform has 8 values, but sdf needs 24"),
    ],
)
def test_bad_archives(tmp_path, arrays, message):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(UserError, match=f"a.npz: {message}"):
        LatticeFields.load(tmp_path / "a.npz")


def test_unreadable(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"nonsense")
    for name in ("a.npz", "missing.npz"):
        with pytest.raises(UserError, match=f"{name}: cannot be read as an .npz archive"):
            LatticeFields.load(tmp_path / name)


@pytest.mark.parametrize("resolution", [4, 5, 8, 16])
def test_resampling_keeps_linear_fields_and_lengths(resolution):
    old, new = TetLattice(8), TetLattice(resolution)
    p = old.vertex_positions()
    offset = np.array([0.1, -0.2, 0.3]) * p  # of at most 0.3 in units of the old cells
    fields = LatticeFields(p[:, 0], p @ np.float32([1, 2, 3]), offset.astype(np.float32).ravel())
    result = fields.to_lattice(resolution)
    q = new.vertex_positions()
    assert result.lattice == new and result.sdf.dtype == result.deform.dtype == np.float32
    np.testing.assert_allclose(result.sdf, q[:, 0], atol=1e-5)
    np.testing.assert_allclose(result.msdf, q @ [1, 2, 3], atol=1e-5)
    lengths = result.deform.reshape(-1, 3) * new.max_offset
    np.testing.assert_allclose(lengths, np.array([0.1, -0.2, 0.3]) * q * old.max_offset, atol=1e-6)


@pytest.mark.parametrize("radius", [0, 1, -0.5, 2.0])
def test_sphere_must_fit(radius):
    with pytest.raises(UserError, match="between 0 and 1, not be"):
        sphere(TetLattice(4), radius)
