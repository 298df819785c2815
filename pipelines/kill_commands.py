"""Kills every command that writes with SIGKILL at random moments, and looks at what it leaves.

    python pipelines/kill_commands.py [COMMAND ...] [--kills 10] [--seed 0]

Each command runs to its end twice on a small object, which tells how long it takes and what it writes. Then
it is killed at ``--kills`` moments drawn uniformly from that time; after each kill every file is read as its
users read it. A fit goes on with ``--resume`` until it is done, and begins anew then. Whenever a run comes to
its end, its result must be that of the runs that nothing has killed; after the last one, nothing may be left
over and no input may have changed. Prints a row for each command; exit code 1 if anything is not so.
``pipelines/kill_and_resume.py`` does the same to one large fit.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import trimesh

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "pipelines"), str(ROOT / "tests")]

from bowl import CLOSED, SHORT, write_fit_scene  # noqa: E402
from fitted import open_sphere, write_fit  # noqa: E402
from kill_and_resume import differences, read_everything  # noqa: E402

#: The command's words, and the folder or file that holds its result; {} is the place of all.
COMMANDS = {
    "capture": (["capture", "{}/set", "-o", "{}/s.xml", "--overwrite", "--quiet"], "s"),
    "export": (["export", "{}/fit", "--obj", "--texture-size", "256"], "fit"),
    "turntable": (["turntable", "{}/fit", "--frames", "8", "--size", "64", "--quiet"], "fit"),
    "report": (["report", "{}/fit", "--turntable-frames", "4", "--turntable-size", "64"], "fit"),
    "fit": (["fit", "{}/in/bowl.xml", "-o", "{}/out", "--quiet", "--checkpoint-seconds", "0",
             *SHORT, *CLOSED], "out"),
}

#: How far a fit's surface may be from that of a whole one, in % of its diagonal, and as a multiple of what
#: two whole ones differ by: threads add up in an order that changes, and steps carry that on.
_APART, _TIMES = 0.2, 3


@dataclass
class Row:
    """What the kills of one command have come to.

    Attributes:
        killed: how many met the command alive.
        seconds: of a whole run.
        read: how many files were read whole after kills.
        wrong: what should not be, a sentence each.
    """

    name: str
    killed: int = 0
    seconds: float = 0.0
    read: int = 0
    wrong: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return (f"| {self.name} | {self.seconds:.1f} s | {self.killed} | {self.read} | "
                f"{'; '.join(self.wrong) or 'none'} |")


def prepare(folder: Path) -> None:
    """A fit scene with its targets, a capture of the format mitsuba, a finished fit, and somebody's notes."""
    scene = write_fit_scene(folder / "in")
    (folder / "fit").mkdir()
    write_fit(folder / "fit", open_sphere(3))
    (folder / "fit" / "metrics.json").write_text(json.dumps({
        "scene": "a.xml", "psnr_training": 30.0, "versions": {}, "config": {},
        "training": {"views": {}, "mean": {"psnr": 30.0}},
        "counts": {"vertices": 3, "faces": 1, "boundary_loops": 1, "components": 1},
        "seconds": {"total": 1.0}}))
    (folder / "set").mkdir()
    for path in scene.with_suffix("").glob("*.exr"):
        shutil.copy(path, folder / "set")
    text = scene.read_text()
    start, end = text.index("<shape"), text.index("<sensor")
    (folder / "set" / "sensors.xml").write_text(text[:start] + text[end:])
    for name in ("out", "fit"):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "notes.json").write_text('"mine"')


def run(words: list[str], seconds: float | None = None) -> tuple[float, bool]:
    """Runs a command to its end, or kills it after so many seconds.

    Returns:
        How long it took, and whether it was killed.

    Raises:
        RuntimeError: it has failed by itself.
    """
    begin = time.monotonic()
    process = subprocess.Popen([sys.executable, "-m", f"gshell_mi.{words[0]}", *words[1:]],
                               stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        _, told = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return time.monotonic() - begin, process.returncode == -signal.SIGKILL
    if process.returncode != 0:
        raise RuntimeError(f"{words[0]} ended with exit code {process.returncode}: {told}")
    return time.monotonic() - begin, False


def kill(name: str, folder: Path, kills: int, seed: int = 0) -> Row:
    """Kills one command in a prepared folder."""
    command, place = COMMANDS[name]
    words, place = [word.format(folder) for word in command], folder / place
    row, before, whole = Row(name), _inputs(folder), []
    for number in range(2):    # the first one compiles
        row.seconds, _ = run(words + _going_on(name, place))
        whole.append(shutil.copytree(place, folder / f"whole_{number}"))
    rng = random.Random(f"{name} {seed}")
    for number in range(kills + 1):
        last = number == kills
        if last:
            time.sleep(1.1)    # what was being written just now may still be
        _, killed = run(words + _going_on(name, place), None if last else rng.uniform(0.1, 1) * row.seconds)
        row.killed += killed
        try:
            row.read += read_everything(place) if place.is_dir() else 0
        except Exception as error:
            row.wrong.append(f"{type(error).__name__} after a kill: {error}")
        if not killed:
            row.wrong += _different(name, whole, place)
    row.wrong += [f"{path.name} is left over" for path in place.rglob(".*")]
    if _inputs(folder) != before:
        row.wrong.append("inputs have changed")
    return row


def _going_on(name: str, place: Path) -> list[str]:
    """How a command is told what to do with what is there."""
    if name != "fit":
        return []
    if (place / ".unfinished" / "checkpoint.npz").is_file():
        return ["--resume"]
    if (place / "metrics.json").is_file():
        return ["--overwrite"]
    return ["--resume"] if (place / "checkpoint.npz").is_file() else []


def _inputs(folder: Path) -> dict[str, bytes]:
    """What no command may change."""
    paths = [*(folder / "in").rglob("*"), *(folder / "set").rglob("*"),
             *(folder / name / "notes.json" for name in ("out", "fit"))]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths if path.is_file()}


def _different(name: str, whole: list[Path], place: Path) -> list[str]:
    """What is not as in whole runs."""
    found = [f"{path.name} is missing" for path in whole[1].iterdir() if not (place / path.name).exists()]
    if name != "fit":
        one, other = _content(name, whole[1]), _content(name, place)
        return found + [f"{file} differs" for file in one if not np.array_equal(one[file], other.get(file))]
    natural = differences(*whole)["distance %"]
    apart = min(differences(folder, place)["distance %"] for folder in whole)
    if apart > max(_APART, _TIMES * natural):
        found.append(f"the surface is {apart:.2f} % away (whole ones {natural:.2f} %)")
    if _steps(place) != _steps(whole[1]):
        found.append("other steps are logged")
    return found


def _steps(place: Path) -> list[tuple[str, int]]:
    lines = map(json.loads, (place / "log.jsonl").read_text().splitlines())
    return [(line["stage"], line["iteration"]) for line in lines]


def _content(name: str, place: Path) -> dict:
    """What is the same in every whole run, by file."""
    if name == "turntable":
        return {"turntable.mp4": imageio_ffmpeg.count_frames_and_secs(str(place / "turntable.mp4"))[0]}
    if name == "export":
        mesh = trimesh.load(place / "mesh.glb", force="mesh")
        return {"mesh.glb": np.round(np.sort(mesh.vertices, axis=0), 5)}
    if name == "report":
        return {"report.html": (place / "report.html").read_text(encoding="utf-8").count("data:")}
    paths = [path for path in place.rglob("*") if path.suffix in (".exr", ".xml")]
    return {path.name: np.frombuffer(path.read_bytes(), np.uint8) for path in paths}


def main(arguments: list[str] | None = None) -> int:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("commands", nargs="*", help=f"of {', '.join(COMMANDS)} (default all)")
    parser.add_argument("--kills", type=int, default=10, help="of each command (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default 0)")
    given = parser.parse_args(arguments)
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    print("| command | a whole run | kills | files read whole | wrong |\n" + "|---" * 5 + "|", flush=True)
    rows = []
    for name in given.commands or COMMANDS:
        with tempfile.TemporaryDirectory() as folder:
            prepare(Path(folder))
            rows.append(kill(name, Path(folder), given.kills, given.seed))
            print(rows[-1], flush=True)
    return int(any(row.wrong for row in rows))


if __name__ == "__main__":
    sys.exit(main())
