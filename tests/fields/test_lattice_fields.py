import drjit as dr
import mitsuba as mi
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
        ({"sdf": np.ones(9)}, r"sdf does not fit: 9 values are not \(resolution \+ 1\)\^3"),
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


@pytest.mark.parametrize(
    ("resolution", "grid"), [(4, "tet"), (5, "tet"), (8, "tet"), (16, "tet"), (8, "cube"), (6, "bcc")]
)
def test_resampling_keeps_linear_fields_and_lengths(resolution, grid):
    old, new = TetLattice(8), make_lattice(grid, resolution)
    p = old.vertex_positions()
    offset = np.array([0.1, -0.2, 0.3]) * p  # of at most 0.3 in units of the old cells
    fields = LatticeFields(p[:, 0], p @ np.float32([1, 2, 3]), offset.astype(np.float32).ravel())
    result = fields.to_lattice(resolution, grid)
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


@pytest.mark.parametrize("resolution", [16, 40, 70])
def test_fields_in_blocks_are_those_of_the_whole_lattice(resolution):
    """Of this lattice or, where they are linear, of a finer one."""
    old = TetLattice(16)
    p = old.vertex_positions()
    offset = (0.3 * p).astype(np.float32)
    fields = LatticeFields(p[:, 1] - np.float32(0.31), p @ np.float32([1, 2, 3]), offset.ravel())
    stored = fields.in_blocks(None if resolution == 16 else resolution)
    whole = fields.to_lattice(resolution)
    lattice = stored.lattice
    assert lattice.resolution == resolution and (resolution == 16 or lattice.fraction < 0.61)
    for name in ("sdf", "msdf", "deform"):
        expected = lattice.take(mi.Float(getattr(whole, name))).numpy()
        inside = lattice.in_lattice(dr.arange(mi.UInt32, lattice.vertex_count)).numpy()
        inside = inside.repeat(len(expected) // len(inside))
        np.testing.assert_allclose(getattr(stored, name)[inside], expected[inside], atol=2e-5)


def test_fields_in_blocks_and_files(tmp_path):
    fields = sphere(TetLattice(40), 0.41, in_blocks=True)
    np.testing.assert_array_equal(fields.blocks, sphere(TetLattice(40), 0.41).in_blocks().blocks)
    fields.save(tmp_path / "a.npz")
    again = LatticeFields.load(tmp_path / "a.npz")
    assert again.lattice.resolution == 40 and again.lattice.vertex_count == again.sdf.size
    np.testing.assert_array_equal(again.sdf, fields.sdf)
    with pytest.raises(UserError, match="fields in blocks are known near their surface only"):
        fields.to_lattice(20)
    np.savez(tmp_path / "b.npz", sdf=fields.sdf[1:], blocks=fields.blocks, block_resolution=40)
    with pytest.raises(UserError, match=rf"sdf has {fields.sdf.size - 1} values, but its blocks have"):
        LatticeFields.load(tmp_path / "b.npz").lattice  # noqa: B018


def test_fields_in_blocks_on_all_of_their_lattice():
    stored, known = sphere(TetLattice(40), 0.41, in_blocks=True), sphere(TetLattice(40), 0.41)
    whole = stored.whole()
    assert whole.lattice == TetLattice(40) and whole.whole() is whole
    np.testing.assert_array_equal(whole.sdf < 0, known.sdf < 0)
    near = np.abs(known.sdf) < 3 * TetLattice(40).spacing
    np.testing.assert_allclose(whole.sdf[near], known.sdf[near], atol=1e-6)
