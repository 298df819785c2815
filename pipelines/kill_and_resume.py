"""Kills a fit with SIGKILL at random moments, resumes it each time, and compares the end with whole fits.

    python pipelines/kill_and_resume.py SCENE.xml WORK [--kills 10] [--whole 3] [--one-core] [-- OPTIONS]

Whole fits come first; the last of them tells how long each part of a fit takes. Then a fit is started and
killed at ``--kills`` moments drawn uniformly from that time, from the start of the process to the report;
after each kill every file in the folder is read, and the fit goes on with ``--resume`` (or from the start, if
it was killed before its first checkpoint). At the end the differences of the killed fit to the whole ones are
printed beside those of the whole ones to each other: threads add up in an order that changes, so no two fits
are the same. ``--one-core`` keeps all threads on one core, where orders change less; if whole fits are
equal, the killed one has to be. Exit code 1 if on average the killed fit is farther from the whole ones than
any two of these.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import imageio_ffmpeg
import mitsuba as mi
import numpy as np
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from gshell_mi.export.ply import read_ply
from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint

#: What a fit writes after its last step, in this order.
ENDING = ("mesh.ply", "template.ply", "light.exr", "scene.xml", "metrics.json", "mesh.glb", "report.html")

_POLL_SECONDS = 0.005


@dataclass(frozen=True)
class Moment:
    """A point of a fit's course: ``seconds`` after it had logged ``steps`` and written ``files``."""

    steps: int
    files: int
    seconds: float


class Run:
    """The command ``python -m gshell_mi.fit`` in a process of its own, watched from outside."""

    def __init__(self, scene: Path, output: Path, options: list[str], *, one_core: bool = False):
        self.output, self.begin = output, time.time()
        resume = ["--resume"] if (output / "checkpoint.npz").exists() else []
        command = [sys.executable, "-m", "gshell_mi.fit", str(scene), "-o", str(output), "--quiet"]
        self.process = subprocess.Popen(
            [*command, *options, *resume],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=_stay_on_one_core if one_core else None,
        )

    def reached(self) -> tuple[int, int]:
        """Steps logged, and files of the ending that this process has written."""
        log = self.output / "log.jsonl"
        steps = log.read_bytes().count(b"\n") if log.exists() else 0
        written = 0
        for name in ENDING:
            try:
                written += (self.output / name).stat().st_mtime >= self.begin
            except FileNotFoundError:
                pass
        return steps, written

    def wait(self) -> None:
        """Until it has ended, which must be well."""
        _, told = self.process.communicate()
        if self.process.returncode != 0:
            raise RuntimeError(f"the fit ended with exit code {self.process.returncode}: {told}")

    def timeline(self) -> list[tuple[float, tuple[int, int]]]:
        """When it reached what, until it ends; seconds since its start."""
        course = [(0.0, (0, 0))]
        while self.process.poll() is None:
            now = self.reached()
            if now != course[-1][1]:
                course.append((time.time() - self.begin, now))
            time.sleep(_POLL_SECONDS)
        self.wait()
        return [*course, (time.time() - self.begin, course[-1][1])]

    def kill_at(self, moment: Moment) -> bool:
        """Kills it then; False if it has ended before."""
        while self.process.poll() is None and self.reached() < (moment.steps, moment.files):
            time.sleep(_POLL_SECONDS)
        deadline = time.time() + moment.seconds
        while self.process.poll() is None and time.time() < deadline:
            time.sleep(_POLL_SECONDS)
        if self.process.poll() is not None:
            self.wait()
            return False
        self.process.kill()
        self.process.communicate()
        return self.process.returncode == -signal.SIGKILL


def _stay_on_one_core() -> None:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def moments(course: list[tuple[float, tuple[int, int]]], count: int, rng: random.Random) -> list[Moment]:
    """``count`` moments, uniform over the time of a whole fit, in order."""
    found = []
    for at in sorted(rng.uniform(0, course[-1][0]) for _ in range(count)):
        since, reached = max(entry for entry in course if entry[0] <= at)
        found.append(Moment(*reached, at - since))
    return found


def read_everything(output: Path) -> int:
    """Reads every file in a fit's folder as its users would; returns how many there are.

    Hidden files are what a kill may leave of one that was being written. Raises whatever a reader raises of a
    file that is not whole.
    """
    count = 0
    for path in output.rglob("*.*"):
        if not path.name.startswith("."):
            _READERS[path.suffix](path)
            count += 1
    return count


def _read_log(path: Path) -> None:
    # The last line may be cut; resuming drops it.
    for line in path.read_text().splitlines(keepends=True):
        if line.endswith("\n"):
            json.loads(line)


def _read_page(path: Path) -> None:
    if not path.read_text().rstrip().endswith("</html>"):
        raise ValueError(f"{path} is cut")


_READERS = {
    ".npz": Checkpoint.load,
    ".ply": read_ply,
    ".glb": trimesh.load,
    ".xml": ElementTree.parse,
    ".json": lambda path: json.loads(path.read_text()),
    ".jsonl": _read_log,
    ".html": _read_page,
    ".exr": lambda path: mi.Bitmap(str(path)),
    ".png": lambda path: Image.open(path).load(),
    ".gif": lambda path: Image.open(path).load(),
    ".mp4": imageio_ffmpeg.count_frames_and_secs,
    ".obj": trimesh.load,
    ".mtl": lambda path: path.read_text(),
}


def differences(first: Path, second: Path) -> dict[str, float]:
    """Of two finished fits: mean distance of a vertex to the nearest of the other (% of the diagonal), PSNR
    on the training views (dB) and number of vertices."""
    a, b = (read_ply(folder / "mesh.ply").vertices for folder in (first, second))
    distance = (cKDTree(a).query(b)[0].mean() + cKDTree(b).query(a)[0].mean()) / 2
    psnr = [json.loads((folder / "metrics.json").read_text())["psnr_training"] for folder in (first, second)]
    return {
        "distance %": 100 * distance / np.linalg.norm(np.ptp(a, axis=0)),
        "PSNR dB": abs(psnr[0] - psnr[1]),
        "vertices": abs(len(a) - len(b)),
    }


def study(
    scene: Path, work: Path, options: list[str], *, kills: int, whole: int, seed: int, one_core: bool = False
) -> tuple[list[dict[str, float]], list[dict[str, float]]]:
    """Runs it all; the differences of the whole fits to each other, and of the killed one to them."""
    fits = [work / f"whole_{number}" for number in range(whole)]
    for folder in (*fits, work / "killed"):
        shutil.rmtree(folder, ignore_errors=True)
    run = partial(Run, scene, options=options, one_core=one_core)
    # The first one compiles what the others find in Dr.Jit's cache, so its time tells little.
    for folder in fits[:-1]:
        run(folder).wait()
    course = run(fits[-1]).timeline()
    killed = work / "killed"
    for moment in moments(course, kills, random.Random(seed)):
        if run(killed).kill_at(moment):
            print(
                f"killed {moment.seconds:.2f} s after {moment.steps} steps and {moment.files} files of the "
                f"ending; {read_everything(killed) if killed.exists() else 0} files are whole",
                flush=True,
            )
    run(killed).wait()
    read_everything(killed)
    return (
        [differences(a, b) for a, b in itertools.combinations(fits, 2)],
        [differences(killed, folder) for folder in fits],
    )


def farther(between: list[dict[str, float]], to_killed: list[dict[str, float]]) -> bool:
    """Whether the killed fit's surface is on average farther from the whole ones than any two of these."""
    name = "distance %"
    return np.mean([entry[name] for entry in to_killed]) > max(entry[name] for entry in between)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path, help="a fit scene")
    parser.add_argument("work", type=Path, help="folder for the fits")
    parser.add_argument("--kills", type=int, default=10, help="kills of the one fit (default 10)")
    parser.add_argument("--whole", type=int, default=3, help="fits that nothing kills (default 3)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default 0)")
    parser.add_argument("--one-core", action="store_true", help="keep all threads on one core (Linux)")
    own, options = sys.argv[1:], []
    if "--" in own:
        own, options = own[: own.index("--")], own[own.index("--") + 1 :]
    given = parser.parse_args(own)
    mi.set_variant("llvm_ad_rgb")
    between, to_killed = study(
        given.scene,
        given.work,
        options,
        kills=given.kills,
        whole=given.whole,
        seed=given.seed,
        one_core=given.one_core,
    )
    for name in between[0]:
        a, b = ([entry[name] for entry in entries] for entries in (between, to_killed))
        print(
            f"{name}: whole fits differ by {np.mean(a):.3g} (at most {max(a):.3g}), "
            f"the killed one from them by {np.mean(b):.3g} (at most {max(b):.3g})"
        )
    return int(farther(between, to_killed))


if __name__ == "__main__":
    sys.exit(main())
