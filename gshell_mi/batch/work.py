"""One job, as a worker runs it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ..lifetime import end_with_parent
from .jobs import OUT, Job

#: Written last, beside the results of a job that came to its end.
DONE = "job.json"
_KEPT_LINES = 20


def run_job(job: Job, results: str) -> dict:
    """Runs a job and leaves its files in ``results/NAME``; returns what became of it.

    A fit that was cut off goes on from its checkpoint, where the results are on a disk. Results on other
    storage are written whole after the job.

    Args:
        results: a folder, or any URL that ``fsspec`` knows.

    Returns:
        ``name``, ``status`` (``done``, ``wrong`` after a mistake in its input, or ``failed``), ``code``,
        ``seconds``, ``told`` (its last words) and ``psnr`` if it has one.
    """
    if "://" not in results:
        folder = Path(results) / job.name
        folder.mkdir(parents=True, exist_ok=True)
        found = _run(job, folder / "out")
        _write_done(folder / DONE, found)
        return found
    import fsspec

    with tempfile.TemporaryDirectory(prefix="gshell_mi_") as scratch:
        out = Path(scratch) / "out"
        found = _run(job, out)
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
        except (OSError, ValueError):
            continue
        if isinstance(told, dict) and told.get("status") == "done" and told.get("job") == _identity(job):
            found[job.name] = told
    return found


def _run(job: Job, out: Path) -> dict:
    arguments = job.filled_in(str(out))
    if any(f"{OUT}/" in argument for argument in job.arguments):
        out.mkdir(exist_ok=True)
    elif job.command == "fit" and out.is_dir():
        arguments.append("--resume" if (out / "checkpoint.npz").is_file() else "--overwrite")
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
        score = json.loads((out / "metrics.json").read_text(encoding="utf-8"))["psnr_training"]
        return found | {"psnr": round(float(score), 3)}
    except (OSError, ValueError, KeyError, TypeError):
        return found


def _identity(job: Job) -> list[str]:
    return [job.command, *job.arguments]


def _write_done(path: Path, found: dict) -> None:
    from ..files import replacing

    with replacing(path) as partial:
        partial.write_text(json.dumps(found), encoding="utf-8")
