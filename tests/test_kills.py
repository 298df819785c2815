"""SIGKILL at random moments of every command that writes: each file is whole, and the next run tidies up."""

import importlib
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bowl import CLOSED, SHORT
from fitted import open_sphere, write_fit

KILLS = 3


@pytest.fixture(scope="module")
def reads(pytestconfig):
    """What reads every file of a folder as its users do."""
    sys.path.insert(0, str(pytestconfig.rootpath / "pipelines"))
    try:
        return importlib.import_module("kill_and_resume").read_everything
    finally:
        sys.path.pop(0)


def hidden(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.name.startswith(".")]


def run(command: list[str], seconds: float | None = None) -> float:
    """Runs a command to its end, or kills it after so many seconds; returns how long it took."""
    begin = time.monotonic()
    process = subprocess.Popen([sys.executable, "-m", *command], stdout=subprocess.DEVNULL,
                               stderr=subprocess.PIPE, text=True)
    try:
        _, told = process.communicate(timeout=seconds)
        assert process.returncode == 0, told
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    return time.monotonic() - begin


@pytest.fixture
def folder(tmp_path, bowl_scene) -> Path:
    """A fit, a capture of the format mitsuba, and notes in each folder that will be written."""
    (tmp_path / "fit").mkdir()
    write_fit(tmp_path / "fit", open_sphere(3))
    (tmp_path / "fit" / "metrics.json").write_text(json.dumps({
        "scene": "a.xml", "psnr_training": 30.0, "psnr_per_view": {}, "versions": {}, "config": {},
        "counts": {"vertices": 3, "faces": 1, "boundary_loops": 1, "components": 1},
        "seconds": {"total": 1.0}}))
    (tmp_path / "set").mkdir()
    for path in bowl_scene.with_suffix("").glob("*.exr"):
        shutil.copy(path, tmp_path / "set")
    shutil.copy(bowl_scene, tmp_path / "set" / "sensors.xml")
    text = (tmp_path / "set" / "sensors.xml").read_text()
    start, end = text.index("<shape"), text.index("<sensor")
    (tmp_path / "set" / "sensors.xml").write_text(text[:start] + text[end:])
    shutil.copytree(bowl_scene.parent, tmp_path / "in")
    for name in ("out", "fit"):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "notes.json").write_text('"mine"')
    return tmp_path


COMMANDS = {
    "capture": ["gshell_mi.capture", "{}/set", "-o", "{}/s.xml", "--overwrite", "--quiet"],
    "export": ["gshell_mi.export", "{}/fit", "--obj", "--texture-size", "256"],
    "turntable": ["gshell_mi.turntable", "{}/fit", "--frames", "8", "--size", "64", "--quiet"],
    "report": ["gshell_mi.report", "{}/fit", "--turntable-frames", "4", "--turntable-size", "64"],
    "fit": ["gshell_mi.fit", "{}/in/bowl.xml", "-o", "{}/out", "--overwrite", "--quiet",
            "--checkpoint-seconds", "0", *SHORT, *CLOSED, "--iterations", "2"],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_killed(folder, reads, name):
    command = [word.format(folder) for word in COMMANDS[name]]
    run(command)  # compiles, and leaves an earlier result to be replaced
    whole = run(command)
    places = [path for path in (folder / "s", folder / "fit", folder / "out") if path.is_dir()]
    rng = random.Random(name)
    for _ in range(KILLS):
        run(command, rng.uniform(0.3, 1) * whole)
        for place in places:
            reads(place)
    time.sleep(1.1)  # what was being written just now may still be
    run(command)
    assert not hidden(folder)
    assert sum(map(reads, places)) > 5
    for place in ("out", "fit"):
        assert (folder / place / "notes.json").read_text() == '"mine"'
    assert len(list((folder / "set").iterdir())) == 13 and len(list(folder.glob("in/bowl/*.exr"))) == 12
