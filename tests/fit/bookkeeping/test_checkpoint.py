"""Checkpoints: exact round trips, and what happens to damaged ones and on a full disk."""

import errno
import json
import os

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi import UserError
from gshell_mi.fit.bookkeeping.checkpoint import FORMAT, Checkpoint
from gshell_mi.optimizer_arrays import optimizer_arrays, restore_optimizer


@pytest.fixture
def checkpoint() -> Checkpoint:
    rng = np.random.default_rng(0)
    arrays = {
        "sdf": rng.normal(size=27).astype(np.float32),
        "known": np.array([True, False]),
        "appearance/opacity/step": np.array([3], np.uint32),
    }
    return Checkpoint(
        "openings", 17, {"seed": 3, "resolution": None, "spp": 8, "warmup": 0.15}, arrays, {"hull": 1.25}
    )


def test_round_trip(checkpoint, tmp_path):
    path = tmp_path / "checkpoint.npz"
    checkpoint.save(path)
    loaded = Checkpoint.load(path)
    for name in ("stage", "iteration", "config", "seconds"):
        assert getattr(loaded, name) == getattr(checkpoint, name)
    assert set(loaded.arrays) == set(checkpoint.arrays)
    for name, array in checkpoint.arrays.items():
        assert loaded.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(loaded.arrays[name], array)
    assert [entry.name for entry in tmp_path.iterdir()] == ["checkpoint.npz"]


def train(optimizer: mi.ad.Adam, steps: range) -> None:
    """Steps on a loss that changes with time, so that moments and step counts matter."""
    for step in steps:
        loss = dr.sum(dr.square(optimizer["a"] - dr.sin(step + dr.arange(mi.Float, 5))))
        loss += dr.sum(dr.abs(optimizer["b"].array - 0.1 * step))
        dr.backward(loss)
        optimizer.set_learning_rate({"a": 0.1 * 0.9**step, "b": 0.05})
        optimizer.step()


def adam(uniform: bool) -> mi.ad.Adam:
    optimizer = mi.ad.Adam(lr=0.1, uniform=uniform)
    optimizer["a"] = mi.Float([1, 2, 3, 4, 5])
    optimizer["b"] = mi.TensorXf([1.0, -1, 2, -2, 3, -3], (1, 2, 3))
    return optimizer


@pytest.mark.parametrize("uniform", [False, True])
def test_a_restored_optimizer_goes_on_as_if_nothing_had_been(uniform, tmp_path):
    whole = adam(uniform)
    train(whole, range(12))

    stopped = adam(uniform)
    train(stopped, range(7))
    path = tmp_path / "checkpoint.npz"
    Checkpoint("joint", 7, {}, optimizer_arrays("shading", stopped)).save(path)
    resumed = adam(uniform)
    restore_optimizer("shading", resumed, Checkpoint.load(path).arrays)
    for name in ("a", "b"):
        np.testing.assert_array_equal(np.array(resumed[name]), np.array(stopped[name]))
        assert type(resumed[name]) is type(stopped[name]) and dr.grad_enabled(resumed[name])
    train(resumed, range(7, 12))
    for name in ("a", "b"):
        np.testing.assert_array_equal(np.array(resumed[name]), np.array(whole[name]))

    forgetful = adam(uniform)
    for name in ("a", "b"):
        forgetful[name] = dr.detach(stopped[name])
    train(forgetful, range(7, 12))
    assert not np.array_equal(np.array(forgetful["a"]), np.array(whole["a"])), "moments do matter here"


def test_optimizers_do_not_mix():
    first, second = adam(False), adam(False)
    train(first, range(3))
    arrays = optimizer_arrays("one", first) | optimizer_arrays("two", second)
    restored = adam(False)
    restore_optimizer("two", restored, arrays)
    np.testing.assert_array_equal(np.array(restored["a"]), [1, 2, 3, 4, 5])


def test_missing(tmp_path):
    with pytest.raises(UserError, match=r"no checkpoint '.*none.npz' to resume from; start without --resume"):
        Checkpoint.load(tmp_path / "none.npz")


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:100],
        lambda data: b"",
        lambda data: b"x" * 500,
        lambda data: data[: len(data) // 2] + data[len(data) // 2 + 1 :],
    ],
)
def test_damaged(checkpoint, tmp_path, damage):
    path = tmp_path / "checkpoint.npz"
    checkpoint.save(path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(UserError, match=r"checkpoint.npz' is damaged \(.+\); delete it"):
        Checkpoint.load(path)


def test_without_header(tmp_path):
    np.savez(tmp_path / "checkpoint.npz", sdf=np.zeros(8))
    with pytest.raises(UserError, match="is damaged"):
        Checkpoint.load(tmp_path / "checkpoint.npz")


@pytest.mark.parametrize("version", [FORMAT - 1, FORMAT + 1])
def test_another_version(version, tmp_path):
    header = json.dumps({"format": version, "something": "else"})
    np.savez(tmp_path / "checkpoint.npz", header=np.array(header))
    with pytest.raises(UserError, match="written by another version of gshell_mi"):
        Checkpoint.load(tmp_path / "checkpoint.npz")


def crafted(path, change) -> None:
    """The checkpoint with another header, or other arrays below it."""
    with np.load(path) as stored:
        arrays = dict(stored)
    header = json.loads(str(arrays.pop("header")))
    header = change(header, arrays) or header
    np.savez(path, header=np.array(json.dumps(header)), **arrays)


def rename(arrays, before, after):
    arrays[after] = arrays.pop(before)


@pytest.mark.parametrize(
    "change",
    [
        lambda header, arrays: [1],
        lambda header, arrays: 5,
        lambda header, arrays: header | {"more": 1},
        lambda header, arrays: header | {"stage": 3},
        lambda header, arrays: header | {"iteration": -5},
        lambda header, arrays: header | {"iteration": "1"},
        lambda header, arrays: header | {"iteration": True},
        lambda header, arrays: header | {"config": []},
        lambda header, arrays: header | {"seconds": [1]},
        lambda header, arrays: header | {"seconds": {"hull": "1"}},
        lambda header, arrays: header | {"inputs": 1},
        lambda header, arrays: header | {"inputs": {"views": 1}},
        lambda header, arrays: header.pop("arrays") and None,
        lambda header, arrays: header.pop("facts") and None,
        lambda header, arrays: arrays.pop("sdf") is None,
        lambda header, arrays: rename(arrays, "sdf", "sdg"),
        lambda header, arrays: arrays.update(sdf=np.array(["a", "b"])),
        lambda header, arrays: arrays.update(sdf=arrays["sdf"][:8]),
        lambda header, arrays: arrays.update(sdf=arrays["sdf"].astype(np.float64)),
        lambda header, arrays: arrays.update(sdf=np.array([{}], object)),
    ],
)
def test_crafted(checkpoint, tmp_path, change):
    path = tmp_path / "checkpoint.npz"
    checkpoint.save(path)
    crafted(path, change)
    with pytest.raises(UserError, match=r"checkpoint.npz' is damaged \(.+\); delete it"):
        Checkpoint.load(path)


def test_without_a_format(checkpoint, tmp_path):
    checkpoint.save(tmp_path / "checkpoint.npz")
    crafted(tmp_path / "checkpoint.npz", lambda header, arrays: header.pop("format") and None)
    with pytest.raises(UserError, match="written by another version"):
        Checkpoint.load(tmp_path / "checkpoint.npz")


def test_one_that_unpacks_to_much_is_refused_unread(tmp_path):
    """100 MB of zeros in 100 kB; ours are not compressed."""
    zeros = np.zeros(100_000_000, np.uint8)
    np.savez_compressed(tmp_path / "checkpoint.npz", header=np.array("{}"), sdf=zeros)
    with pytest.raises(UserError, match=r"is damaged \(ValueError\)"):
        Checkpoint.load(tmp_path / "checkpoint.npz")


def test_a_missing_array_is_the_files_fault(tmp_path):
    """As of one that was crafted whole."""
    Checkpoint("openings", 0, {}, {"sdf": np.zeros(8)}).save(tmp_path / "checkpoint.npz")
    loaded = Checkpoint.load(tmp_path / "checkpoint.npz")
    with pytest.raises(UserError, match=r"checkpoint.npz' is damaged \(it lacks 'hull'\)"):
        loaded.arrays["hull"]


@pytest.mark.parametrize(("part", "size"), [("value", 4), ("first", 1), ("second", 0), ("step", 2)])
def test_an_optimizer_of_another_size(part, size):
    arrays = optimizer_arrays("shading", adam(False)) | {f"shading/a/{part}": np.zeros(size, np.float32)}
    with pytest.raises(UserError, match="'shading/a' has another size than this fit needs"):
        restore_optimizer("shading", adam(False), arrays)


@pytest.mark.skipif(os.name == "posix" and os.geteuid() == 0, reason="root may read anything")
def test_unreadable(checkpoint, tmp_path):
    checkpoint.save(tmp_path / "checkpoint.npz")
    (tmp_path / "checkpoint.npz").chmod(0)
    with pytest.raises(UserError, match=r"cannot be read \(Permission denied\); mend its permissions"):
        Checkpoint.load(tmp_path / "checkpoint.npz")


def test_a_full_disk_leaves_the_old_one(checkpoint, tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.npz"
    checkpoint.save(path)
    before = path.read_bytes()
    checkpoint.iteration = 18

    def full(file, **_):
        file.write(b"half of it")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("numpy.savez", full)
    with pytest.raises(UserError, match=r"cannot be written \(No space left on device\); free some space"):
        checkpoint.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
