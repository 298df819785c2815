"""Kills every command that writes with SIGKILL at random moments, and looks at what it leaves.

    python pipelines/kill_commands.py [COMMAND ...] [--kills 10] [--seed 0]

Each command runs to its end twice on a small object, which tells how long it takes and what it writes. Then
it is killed at ``--kills`` moments drawn uniformly from that time: the processor's where the system tells it,
as other work on the machine moves the clock's. After each kill every file is read as its users read it. A fit
goes on with ``--resume`` until it is done, and begins anew then. Whenever a run comes to its end, its result
must be that of the runs that nothing has killed; after the last one, nothing may be left over and no input
may have changed. Prints a row for each command; exit code 1 if anything is not so.

The fit goes through every stage, with a mask and cameras that are wrong. It runs on one thread, where whole
fits are equal bit by bit, and so has one to be that was killed: fields, model, meshes, images, metrics and
log. ``pipelines/kill_and_resume.py`` kills one large fit, on all threads.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import trimesh

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "pipelines"), str(ROOT / "tests")]

from bowl import SIZE, write_fit_scene  # noqa: E402
from fitted import open_sphere, write_fit  # noqa: E402
from kill_and_resume import read_everything  # noqa: E402

from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint  # noqa: E402

#: Some steps of every stage of a fit.
EVERY_STAGE = (
    "--occlusion.most",
    "0.1",
    "--openings.iterations",
    "40",
    "--openings.mask",
    "0.01",
    "--openings.binary",
    "0.015",
    "--openings.closing",
    "0.003",
    "--radiance.batch",
    "8192",
    "--radiance.smoothing",
    "8",
    "--cavities.iterations",
    "6",
    "--cavities.batch",
    "4096",
    "--refinement.iterations",
    "8",
    "--folds.iterations",
    "4",
    "--volume.iterations",
    "9",
    "--volume.side",
    "64",
    "--volume.resolution",
    "24",
    "--volume.batch",
    "8192",
    "--iterations",
    "10",
    "--detail.iterations",
    "5",
    "--texture.rounds",
    "1",
    "--render.spp",
    "2",
    "--render.primal-spp",
    "4",
    "--render.max-depth",
    "2",
    "--model.light-height",
    "8",
    "--no-report",
)

#: The command's words, and the folder or file that holds its result; {} is the place of all.
COMMANDS = {
    "capture": (["capture", "{}/set", "-o", "{}/s.xml", "--overwrite", "--quiet"], "s"),
    "export": (["export", "{}/fit", "--obj", "--texture-size", "256"], "fit"),
    "turntable": (["turntable", "{}/fit", "--frames", "8", "--size", "64", "--quiet"], "fit"),
    "report": (["report", "{}/fit", "--turntable-frames", "4", "--turntable-size", "64"], "fit"),
    "dataset": (
        ["dataset", "-o", "{}/data", "--garments", "3", "--side", "16", "--max-chamfer", "50", "--quiet"],
        "data",
    ),
    "fit": (
        ["fit", "{}/in/bowl.xml", "-o", "{}/out", "--quiet", "--checkpoint-seconds", "0", *EVERY_STAGE],
        "out",
    ),
}

#: Metrics that no two runs have in common.
_OF_THE_RUN = {"seconds", "estimated_memory_mib", "peak_memory_mib"}

_POLL_SECONDS = 0.03

#: By how many degrees cameras are wrong: half a pixel is 0.35.
_WRONG = 2.0


@dataclass
class Row:
    """What the kills of one command have come to.

    Attributes:
        killed: how many met the command alive.
        seconds: of a whole run, as of ``run``.
        read: how many files were read whole after kills.
        compared: how many results that were to be like the whole ones.
        stages: of a fit, how often it was killed in each.
        wrong: what should not be, a sentence each.
    """

    name: str
    killed: int = 0
    seconds: float = 0.0
    read: int = 0
    compared: int = 0
    stages: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        stages = "".join(f", {count} in {stage}" for stage, count in self.stages.items())
        return (
            f"| {self.name} | {self.seconds:.1f} s | {self.killed}{stages} | {self.read} | "
            f"{self.compared} | {'; '.join(self.wrong) or 'none'} |"
        )


def prepare(folder: Path) -> None:
    """A fit scene with its targets, a capture of the format mitsuba, a finished fit, and somebody's notes."""
    scene = write_fit_scene(folder / "in")
    _spoil(scene)
    (folder / "fit").mkdir()
    write_fit(folder / "fit", open_sphere(3))
    (folder / "fit" / "metrics.json").write_text(
        json.dumps(
            {
                "scene": "a.xml",
                "psnr_training": 30.0,
                "versions": {},
                "config": {},
                "training": {"views": {}, "mean": {"psnr": 30.0}},
                "counts": {"vertices": 3, "faces": 1, "boundary_loops": 1, "components": 1},
                "seconds": {"total": 1.0},
            }
        )
    )
    (folder / "set").mkdir()
    for path in scene.with_suffix("").glob("*.exr"):
        shutil.copy(path, folder / "set")
    text = scene.read_text()
    start, end = text.index("<shape"), text.index("<sensor")
    (folder / "set" / "sensors.xml").write_text(text[:start] + text[end:])
    for name in ("out", "fit"):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "notes.json").write_text('"mine"')


def _spoil(scene: Path) -> None:
    """Hides half of a view from its mask, and turns the cameras, so that stages find something."""
    import mitsuba as mi

    from gshell_mi.calibration.corrections import Corrections
    from gshell_mi.export.stock_scene import write_scene
    from gshell_mi.scene import load_fit_scene

    loaded = load_fit_scene(scene)
    turns = np.random.default_rng(2).normal(size=(len(loaded.sensors), 3)) * np.radians(_WRONG) / np.sqrt(3)
    turned = scene.with_name("turned.xml")
    write_scene(turned, loaded.light, Corrections(turns, 0 * turns).sensors(loaded.sensors))
    scene.write_text(_around(scene)[0] + _around(turned)[1] + _around(scene)[2])
    turned.unlink()
    hidden = scene.with_suffix("") / "view_005.exr"
    pixels = np.array(mi.Bitmap(str(hidden)))
    pixels[SIZE // 2 :] = 0
    mi.Bitmap(pixels).write(str(hidden))


def _around(scene: Path) -> tuple[str, str, str]:
    """What comes before the sensors of a scene, the sensors, and what comes after."""
    text, end = scene.read_text(), "</sensor>"
    first, last = text.index("<sensor"), text.rindex(end) + len(end)
    return text[:first], text[first:last], text[last:]


def run(words: list[str], seconds: float | None = None) -> tuple[float, bool]:
    """Runs a command to its end, or kills it after so many seconds.

    Returns:
        How many seconds it took, and whether it was killed.

    Raises:
        RuntimeError: it has failed by itself.
    """
    begin, spent = time.monotonic(), 0.0
    script = (
        [str(ROOT / "pipelines" / "one_thread_fit.py")]
        if words[0] == "fit"
        else ["-m", f"gshell_mi.{words[0]}"]
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryFile("w+") as told:
        process = subprocess.Popen(
            [sys.executable, *script, *words[1:]],
            stdout=subprocess.DEVNULL,
            stderr=told,
            cwd=ROOT,
            env=environment,
        )
        while process.poll() is None:
            spent = max(spent, _spent(process.pid, begin))
            if seconds is not None and spent >= seconds:
                process.kill()
                process.wait()
                return spent, process.returncode == -signal.SIGKILL
            time.sleep(_POLL_SECONDS)
        if process.returncode != 0:
            told.seek(0)
            raise RuntimeError(f"{words[0]} ended with exit code {process.returncode}: {told.read()}")
    return spent, False


def _spent(pid: int, begin: float) -> float:
    """Seconds that a process and those of its children that have ended took of the processor; of the clock
    since ``begin`` where no system tells."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:  # it ends just now, or there is no such file
        return 0.0 if Path("/proc/self/stat").exists() else time.monotonic() - begin
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def kill(name: str, folder: Path, kills: int, seed: int = 0) -> Row:
    """Kills one command in a prepared folder."""
    command, place = COMMANDS[name]
    words, place = [word.format(folder) for word in command], folder / place
    row, before, whole = Row(name), _inputs(folder), []
    for number in range(2):  # the first one compiles
        row.seconds, _ = run(words + _going_on(name, place))
        whole.append(shutil.copytree(place, folder / f"whole_{number}"))
    row.wrong += [f"whole runs: {what}" for what in _different(name, whole[1], whole[0])]
    rng = random.Random(f"{name} {seed}")
    for number in range(kills + 1):
        last = number == kills
        if last:
            time.sleep(1.1)  # what was being written just now may still be
        _, killed = run(words + _going_on(name, place), None if last else rng.uniform(0.1, 1) * row.seconds)
        row.killed += killed
        if killed and name == "fit":
            row.stages[_stage(place)] += 1
        try:
            row.read += read_everything(place) if place.is_dir() else 0
        except Exception as error:
            row.wrong.append(f"{type(error).__name__} after a kill: {error}")
        if not killed:
            row.compared += 1
            row.wrong += _different(name, whole[1], place)
    row.wrong += [f"{path.name} is left over" for path in place.rglob(".*")]
    if _inputs(folder) != before:
        row.wrong.append("inputs have changed")
    return row


def _going_on(name: str, place: Path) -> list[str]:
    """How a command is told what to do with what is there."""
    if name == "dataset" and place.is_dir() and (place / "statistics.json").is_file():
        shutil.rmtree(place)  # it is whole, and made anew
    if name != "fit":
        return []
    if (place / ".unfinished" / "checkpoint.npz").is_file():
        return ["--resume"]
    if (place / "metrics.json").is_file():
        return ["--overwrite"]
    return ["--resume"] if (place / "checkpoint.npz").is_file() else []


def _inputs(folder: Path) -> dict[str, bytes]:
    """What no command may change."""
    paths = [
        *(folder / "in").rglob("*"),
        *(folder / "set").rglob("*"),
        *(folder / name / "notes.json" for name in ("out", "fit")),
    ]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths if path.is_file()}


def _stage(place: Path) -> str:
    """The stage that a fit was killed in."""
    paths = [place / ".unfinished" / "checkpoint.npz", place / "checkpoint.npz"]
    found = next((path for path in paths if path.is_file()), None)
    return Checkpoint.load(found).stage if found else "the start"


def _different(name: str, whole: Path, place: Path) -> list[str]:
    """What is not as in a whole run."""
    one, other = _content(name, whole), _content(name, place)
    found = [f"{file} is missing" for file in one if file not in other]
    return found + [f"{file} differs" for file in one if file in other and not _equal(one[file], other[file])]


def _equal(one: Any, other: Any) -> bool:
    return np.array_equal(one, other) if isinstance(one, np.ndarray) else one == other


def _content(name: str, place: Path) -> dict[str, Any]:
    """What is the same in every whole run, by file."""
    files = {path.relative_to(place).as_posix(): path for path in place.rglob("*") if path.is_file()}
    if name == "turntable":
        return {"turntable.mp4": imageio_ffmpeg.count_frames_and_secs(str(place / "turntable.mp4"))[0]}
    if name == "export":
        mesh = trimesh.load(place / "mesh.glb", force="mesh")
        return {"mesh.glb": np.round(np.sort(mesh.vertices, axis=0), 5)}
    if name == "report":
        return {"report.html": (place / "report.html").read_text(encoding="utf-8").count("data:")}
    found: dict[str, Any] = {
        file: path.read_bytes()
        for file, path in files.items()
        if path.suffix not in (".json", ".jsonl", ".npz")
    }
    if name == "dataset":
        arrays = {file: dict(np.load(path)) for file, path in files.items() if path.suffix == ".npz"}
        return {
            f"{array} of {file}": values for file, each in arrays.items() for array, values in each.items()
        }
    if name == "fit":
        checkpoint = Checkpoint.load(place / "checkpoint.npz")
        found |= {f"{array} of the checkpoint": values for array, values in checkpoint.arrays.items()}
        found |= {"facts of the checkpoint": checkpoint.facts, "stage of the checkpoint": checkpoint.stage}
        metrics = json.loads((place / "metrics.json").read_text())
        found |= {
            f"{metric} of the metrics": value
            for metric, value in metrics.items()
            if metric not in _OF_THE_RUN
        }
        lines = map(json.loads, (place / "log.jsonl").read_text().splitlines())
        found["log.jsonl"] = [
            {key: value for key, value in line.items() if key != "seconds"} for line in lines
        ]
    return found


def main(arguments: list[str] | None = None) -> int:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("commands", nargs="*", help=f"of {', '.join(COMMANDS)} (default all)")
    parser.add_argument("--kills", type=int, default=10, help="of each command (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default 0)")
    given = parser.parse_args(arguments)
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    print(
        "| command | a whole run | kills | files read whole | results compared | wrong |\n"
        + "|---" * 6
        + "|",
        flush=True,
    )
    rows = []
    for name in given.commands or COMMANDS:
        with tempfile.TemporaryDirectory() as folder:
            prepare(Path(folder))
            rows.append(kill(name, Path(folder), given.kills, given.seed))
            print(rows[-1], flush=True)
    return int(any(row.wrong for row in rows))


if __name__ == "__main__":
    sys.exit(main())
