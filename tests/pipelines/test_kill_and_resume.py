"""The recipe that kills fits: its moments, its reading of folders, and three kills of a small fit."""

import importlib
import json
import random
import subprocess
import sys
from pathlib import Path

import pytest
from bowl import CLOSED, SHORT

SCRIPT = Path(__file__).parents[2] / "pipelines" / "kill_and_resume.py"


@pytest.fixture
def recipe(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    return importlib.import_module("kill_and_resume")


def test_moments_cover_the_whole_fit(recipe):
    course = [(0.0, (0, 0)), (4.0, (1, 0)), (5.0, (2, 0)), (6.0, (2, 1)), (10.0, (2, 1))]
    found = recipe.moments(course, 1000, random.Random(0))
    shares = {state: sum((m.steps, m.files) == state for m in found) / 1000 for _, state in course}
    assert shares == pytest.approx({(0, 0): 0.4, (1, 0): 0.1, (2, 0): 0.1, (2, 1): 0.4}, abs=0.05)
    assert all(0 <= moment.seconds <= 4 for moment in found)
    assert found == sorted(found, key=lambda m: (m.steps, m.files, m.seconds))
    assert found == recipe.moments(course, 1000, random.Random(0))


def test_damaged_files_are_found(recipe, tmp_path):
    log = tmp_path / "log.jsonl"
    log.write_text(json.dumps({"stage": "joint"}) + "\n" + '{"cut')
    (tmp_path / ".partial.mesh.ply").write_bytes(b"pl")
    assert recipe.read_everything(tmp_path) == 1
    for name, text in (
        ("mesh.ply", "ply\nformat"),
        ("metrics.json", "{"),
        ("report.html", "<html>"),
        ("scene.xml", "<scene>"),
        ("checkpoint.npz", "PK"),
        ("mesh.glb", "glTF"),
    ):
        path = tmp_path / name
        path.write_text(text)
        with pytest.raises(Exception):  # noqa: B017 - whatever the reader says
            recipe.read_everything(tmp_path)
        path.unlink()
    log.write_text('{"cut\n' + json.dumps({"stage": "joint"}) + "\n")
    with pytest.raises(json.JSONDecodeError):
        recipe.read_everything(tmp_path)


def test_farther(recipe):
    near, far = [{"distance %": 0.1}, {"distance %": 0.3}], [{"distance %": 0.2}, {"distance %": 0.5}]
    assert recipe.farther(near, far) and not recipe.farther(near, near)


def test_a_fit_that_fails_is_told(recipe, tmp_path):
    run = recipe.Run(tmp_path / "none.xml", tmp_path / "out", [])
    with pytest.raises(RuntimeError, match=r"exit code 2: error: Scene '.*none.xml' does not exist"):
        run.wait()
    ended = recipe.Run(tmp_path / "none.xml", tmp_path / "out", [])
    with pytest.raises(RuntimeError, match="exit code 2"):
        ended.kill_at(recipe.Moment(1, 0, 0.0))


@pytest.mark.slow
def test_kills(bowl_scene, tmp_path):
    options = [*SHORT, *CLOSED, "--checkpoint-seconds", "0.1"]
    command = [sys.executable, SCRIPT, bowl_scene, tmp_path, "--kills", "3", "--whole", "2", "--", *options]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.stdout.count("files are whole") >= 1, result.stderr
    assert "distance %: whole fits differ by" in result.stdout and "Traceback" not in result.stderr
    killed = tmp_path / "killed"
    assert not list(killed.rglob(".*"))
    steps = [
        (entry["stage"], entry["iteration"])
        for entry in map(json.loads, (killed / "log.jsonl").read_text().splitlines())
    ]
    counts = {"openings": 5, "cavities": 4, "refinement": 2, "joint": 12}
    assert steps == [(stage, i) for stage, count in counts.items() for i in range(count)]
