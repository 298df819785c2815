"""One job, as a worker runs it."""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ..json_files import read_json_object
from ..lifetime import end_with_parent
from .jobs import OUT, Job

#: Lies beside a job's results: which job was started there, and what became of it.
DONE = "job.json"
#: Commands that refuse a folder with their own results, unless they are told to replace them.
_CAREFUL = ("capture", "fit")
_KEPT_LINES = 20


def run_job(job: Job, results: str) -> dict:
    """Runs a job and leaves its files in ``results/NAME``; returns what became of it.

    A fit that was cut off goes on from its checkpoint, where the results are on a disk; what a job of other
    arguments has left there is replaced. Results on other storage are written whole after the job.

    Args:
        results: a folder, or any URL that ``fsspec`` knows.

    Returns:
        ``name``, ``status`` (``done``, ``wrong`` after a mistake in its input, or ``failed``), ``code``,
        ``seconds``, ``told`` (its last words) and ``psnr`` if it has one.
    """
    if "://" not in results:
        folder = Path(results) / job.name
        folder.mkdir(parents=True, exist_ok=True)
        try:
            earlier = read_json_object(folder / DONE).get("job")
        except (OSError, ValueError):
            earlier = None
        _write_done(folder / DONE, {"name": job.name, "job": _identity(job), "status": "started"})
        found = _run(job, folder / "out", again=earlier == _identity(job))
        _write_done(folder / DONE, found)
        return found
    import fsspec

    with tempfile.TemporaryDirectory(prefix="gshell_mi_") as scratch:
        out = Path(scratch) / "out"
        found = _run(job, out, again=False)
        storage, root = fsspec.core.url_to_fs(results)
        target = f"{root.rstrip('/')}/{job.name}"
        if out.is_dir():
            storage.makedirs(f"{target}/out", exist_ok=True)
            storage.put(f"{out}/", f"{target}/out/", recursive=True)
        else:
            storage.makedirs(target, exist_ok=True)
        with storage.open(f"{target}/{DONE}", "w") as file:
            json.dump(found, file)
    return found


def finished(results: str, jobs: list[Job]) -> dict[str, dict]:
    """What became of those jobs that have come to a good end, by name."""
    import fsspec

    storage, root = fsspec.core.url_to_fs(results)
    found = {}
    for job in jobs:
        try:
            with storage.open(f"{root.rstrip('/')}/{job.name}/{DONE}", "r") as file:
                told = json.load(file)
        except (OSError, ValueError, RecursionError):
            continue
        if _is_good_end(told, job):
            found[job.name] = told
    return found


def _is_good_end(told: object, job: Job) -> bool:
    """Whether a file that anybody may have written says that the job is done, and is whole."""
    return (
        isinstance(told, dict)
        and [told.get(key) for key in ("status", "job", "name")] == ["done", _identity(job), job.name]
        and isinstance(told.get("told"), str)
        and all(
            isinstance(x, float) and math.isfinite(x) for x in (told.get("seconds"), told.get("psnr", 0.0))
        )
    )


def _run(job: Job, out: Path, *, again: bool) -> dict:
    """Runs a job; returns what became of it.

    Args:
        out: the folder of its results.
        again: whether this very job was the last to write there.
    """
    arguments = job.filled_in(str(out))
    output = _output(arguments)
    if any(f"{OUT}/" in argument for argument in job.arguments):
        out.mkdir(exist_ok=True)
    # Results elsewhere may be anybody's.
    if job.command in _CAREFUL and output is not None and output.is_relative_to(out):
        arguments.append("--resume" if again and _can_resume(output) else "--overwrite")
    environment = dict(os.environ)
    environment.setdefault("OPENBLAS_NUM_THREADS", "1")
    started = time.perf_counter()
    process = subprocess.run(
        [sys.executable, "-m", f"gshell_mi.{job.command}", *arguments],
        text=True,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        errors="replace",
        preexec_fn=end_with_parent,
    )
    code = process.returncode
    told = [line.strip() for line in process.stderr.splitlines() if line.strip()][-_KEPT_LINES:]
    found = {
        "name": job.name,
        "job": _identity(job),
        "code": code,
        "status": "done" if code == 0 else "wrong" if code == 2 else "failed",
        "seconds": round(time.perf_counter() - started, 2),
        "told": "" if code == 0 else "\n".join(told),
    }
    try:
        score = round(float(read_json_object((output or out) / "metrics.json")["psnr_training"]), 3)
    except (OSError, ValueError, KeyError, TypeError):
        return found
    # What failed has left an earlier one's.
    return found | {"psnr": score} if code == 0 and math.isfinite(score) else found


def _output(arguments: list[str]) -> Path | None:
    """Where a command writes that has these arguments, by the last ``-o`` or ``--output``; None without one.

    >>> _output(["a.xml", "-o", "x"]), _output(["-o", "x", "--output=y"]), _output(["a.xml"])
    (PosixPath('x'), PosixPath('y'), None)
    """
    found = None
    for word, after in itertools.pairwise([*arguments, ""]):
        if option := re.fullmatch(r"(?:--output(?:=|$)|-o=?)(.*)", word, re.DOTALL):
            found = Path(option[1] or after)
    return found


def _can_resume(output: Path) -> bool:
    from ..export import can_resume  # loads Mitsuba, which few jobs need here

    return can_resume(output)


def _identity(job: Job) -> list[str]:
    return [job.command, *job.arguments]


def _write_done(path: Path, found: dict) -> None:
    from ..files import replacing

    with replacing(path) as partial:
        partial.write_text(json.dumps(found), encoding="utf-8")
