"""SIGKILL at random moments of every command that writes: each file is whole, and the next run tidies up."""

import importlib
import shutil

import pytest


@pytest.fixture
def recipe(pytestconfig, monkeypatch):
    monkeypatch.syspath_prepend(str(pytestconfig.rootpath / "pipelines"))
    return importlib.import_module("kill_commands")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["capture", "export", "turntable", "report", "fit"])
def test_killed(name, recipe, tmp_path):
    recipe.prepare(tmp_path)
    row = recipe.kill(name, tmp_path, kills=3)
    assert row.wrong == [] and row.killed >= 1 and row.read > 10


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
