"""SIGKILL at random moments of every command that writes: each file is whole, and the next run tidies up."""

import importlib
import json
import shutil

import numpy as np
import pytest

from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint


@pytest.fixture
def recipe(pytestconfig, monkeypatch):
    monkeypatch.syspath_prepend(str(pytestconfig.rootpath / "pipelines"))
    return importlib.import_module("kill_commands")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["capture", "export", "turntable", "report", "fit"])
def test_killed(name, recipe, tmp_path):
    recipe.prepare(tmp_path)
    row = recipe.kill(name, tmp_path, kills=3)
    assert row.wrong == [] and row.killed >= 1 and row.read > 10 and row.compared >= 1
    assert sum(row.stages.values()) == (row.killed if name == "fit" else 0)


def test_a_fit_that_goes_on_otherwise_is_found(recipe, tmp_path):
    """Fields, facts, metrics and steps that are not those of the whole run; seconds may be."""
    for folder, field, step, seconds in (("whole", 1, 1, 5.0), ("same", 1, 1, 6.0), ("other", 2, 2, 5.0)):
        place = tmp_path / folder
        place.mkdir()
        Checkpoint(
            stage="done",
            iteration=0,
            config={},
            arrays={"sdf": np.full(3, field, np.float32)},
            facts={"kept": step},
        ).save(place / "checkpoint.npz")
        (place / "metrics.json").write_text(json.dumps({"psnr_training": field, "seconds": seconds}))
        line = {"stage": "joint", "iteration": step, "seconds": seconds}
        (place / "log.jsonl").write_text(json.dumps(line) + "\n")
        (place / "mesh.ply").write_bytes(bytes([step]))
    assert recipe._different("fit", tmp_path / "whole", tmp_path / "same") == []
    assert set(recipe._different("fit", tmp_path / "whole", tmp_path / "other")) == {
        "mesh.ply differs",
        "sdf of the checkpoint differs",
        "facts of the checkpoint differs",
        "psnr_training of the metrics differs",
        "log.jsonl differs",
    }


def test_what_is_wrong_is_found(recipe, tmp_path, monkeypatch):
    """A command that a kill leaves with half a file, another result, something hidden and a lost input."""
    recipe.prepare(tmp_path)
    runs = iter([(1.0, False), (1.0, False), (0.5, True), (1.0, False)])
    place = tmp_path / "s"

    def run(words, seconds=None):
        took = next(runs)
        place.mkdir(exist_ok=True)
        shutil.copy(tmp_path / "set" / "view_000.exr", place / "view_000.exr")
        (place / "capture.json").write_text("{}")
        if took[1]:
            (place / "capture.json").write_text("{")
        elif seconds is None and (tmp_path / "whole_1").exists():
            shutil.copy(tmp_path / "set" / "view_001.exr", place / "view_000.exr")
            (place / ".left").touch()
            (tmp_path / "set" / "view_002.exr").unlink()
        return took

    monkeypatch.setattr(recipe, "run", run)
    row = recipe.kill("capture", tmp_path, kills=1)
    assert row.killed == 1
    told = " ".join(row.wrong)
    assert "JSONDecodeError after a kill" in told and "view_000.exr differs" in told
    assert ".left is left over" in told and "inputs have changed" in told
