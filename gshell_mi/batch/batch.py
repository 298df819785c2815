"""Many jobs on a Ray cluster."""

from __future__ import annotations

import html
import json
import logging
import time
from collections import deque
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from ..bars import Bars
from ..errors import UserError, first_line
from ..files import replacing
from ..interrupt import check_interrupt
from ..own_folder import OwnFolder, own_folder
from ..wording import counted
from .jobs import Job, read_jobs
from .work import finished, run_job

#: Jobs that Ray is given at once; the others wait here, so that millions do not fill its tables.
_SUBMITTED = 2000
#: Bytes for what is handed from job to job, which is next to nothing; by default Ray takes 30 % of the
#: memory, and does not start where others use it.
_OBJECT_STORE = 128 << 20
#: What the page of results shows of each, beside what it told.
_COLUMNS = ("name", "status", "psnr", "seconds")


def run_batch(
    path: Path,
    output: Path,
    *,
    results: str | None = None,
    address: str | None = None,
    retries: int = 2,
    cpus: float | None = None,
    quiet: bool = True,
) -> str:
    """Runs the jobs of a file that are not done yet; returns what to tell about them.

    Args:
        path: see ``read_jobs``.
        output: the folder that tells what became of them.
        results: folder or ``fsspec`` URL of their files; default: ``jobs`` in ``output``.
        address: of a Ray cluster; None starts one on this machine.
        retries: how often a job is tried again after a failure that is no mistake in its input.
        cpus: of the cluster on this machine; default: its cores.

    Raises:
        UserError: the file is no list of jobs, there is no such cluster, or some jobs failed; all others are
            done then.
    """
    jobs = read_jobs(path)
    try:
        import fsspec  # noqa: F401
        import ray
    except ImportError as error:
        raise UserError(
            f"This needs {'fsspec' if error.name == 'fsspec' else 'Ray'}; install it with pip "
            f"install 'gshell_mi[ray]'."
        ) from None
    output.mkdir(parents=True, exist_ok=True)
    with own_folder(output, "batch") as folder:
        folder.claim("batch.json", "results.jsonl", "results.html")
        if results is None or "://" not in results:  # workers may have another current folder
            results = str(Path(results or output / "jobs").absolute())
        done = finished(results, jobs)
        waiting = deque(job for job in jobs if job.name not in done)
        _write(folder, "batch.json", json.dumps({"jobs": str(path), "results": results, "count": len(jobs)}))
        if waiting:
            _run_all(ray, waiting, done, results, address, retries, cpus, quiet)
        rows = [done[job.name] for job in jobs]
        rows.sort(key=lambda row: (row["status"] == "done", row.get("psnr", float("inf")), row["name"]))
        _write(folder, "results.jsonl", "".join(json.dumps(row) + "\n" for row in rows))
        _write(folder, "results.html", _page(rows))
    failed = [row for row in rows if row["status"] != "done"]
    if failed:
        raise UserError(
            f"{counted(len(failed), 'job')} of {len(rows)} failed, first '{failed[0]['name']}'; "
            f"see '{output / 'results.html'}', and run the same command again to try them anew."
        )
    return f"{output}: {counted(len(rows), 'job')} done; see results.html"


def _run_all(
    ray,
    waiting: deque[Job],
    done: dict[str, dict],
    results: str,
    address: str | None,
    retries: int,
    cpus: float | None,
    quiet: bool,
) -> None:
    try:
        # "local" starts one even where another runs, which would refuse its own numbers.
        own = {"num_cpus": cpus, "include_dashboard": False, "object_store_memory": _OBJECT_STORE}
        where = {"address": address} if address else {"address": "local", **own}
        ray.init(log_to_driver=False, logging_level=logging.ERROR, **where)
    except Exception as error:  # Ray raises whatever it stumbles over
        if not address:
            raise UserError(
                f"Ray cannot start on this machine ({first_line(error)}); give it more memory, or name a "
                f"cluster with --address."
            ) from error
        raise UserError(
            f"There is no Ray cluster at '{address}' ({type(error).__name__}); start one with "
            f"ray start --head, or leave --address out."
        ) from error
    try:
        remote = ray.remote(max_retries=0)(run_job)  # tries are counted here
        tries: dict[str, int] = {}
        running: dict = {}
        columns = (
            TextColumn("batch"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[rate]}"),
        )
        started, ended = time.perf_counter(), 0
        with Bars(*columns, quiet=quiet) as progress:
            bar = progress.add_task("", total=len(waiting) + len(done), completed=len(done), rate="")
            while waiting or running:
                while waiting and len(running) < _SUBMITTED:
                    job = waiting.popleft()
                    needs = {
                        "num_cpus": job.cpus,
                        "num_gpus": job.gpus,
                        "memory": int(job.memory_gib * 2**30) or None,
                    }
                    running[remote.options(**needs).remote(job, results)] = job
                check_interrupt()
                ready, _ = ray.wait(list(running), num_returns=1, timeout=1)
                for reference in ready:
                    job = running.pop(reference)
                    found = _outcome(ray, reference, job)
                    tries[job.name] = tries.get(job.name, 0) + 1
                    if found["status"] == "failed" and tries[job.name] <= retries:
                        waiting.append(job)
                        continue
                    done[job.name] = found
                    ended += 1
                    hourly = 3600 * ended / (time.perf_counter() - started)
                    progress.update(bar, advance=1, rate=f"{hourly:.0f} an hour")
    finally:
        ray.shutdown()


def _outcome(ray, reference, job: Job) -> dict:
    """What became of a job; that its worker died is told like any failure."""
    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        return {
            "name": job.name,
            "status": "failed",
            "code": None,
            "seconds": 0.0,
            "told": f"its worker was lost ({type(error).__name__})",
        }
    except Exception as error:  # what the job's function raised, as where storage cannot be written
        return {"name": job.name, "status": "failed", "code": None, "seconds": 0.0, "told": str(error)}


def _write(folder: OwnFolder, name: str, text: str) -> None:
    with replacing(folder.path / name) as partial:
        partial.write_text(text, encoding="utf-8")


def _page(rows: list[dict]) -> str:
    """A table of results, the worst first."""
    body = "".join(
        f"<tr class='{html.escape(row['status'])}'>"
        + "".join(f"<td>{html.escape(str(row.get(key, '')))}</td>" for key in _COLUMNS)
        + f"<td><pre>{html.escape(row['told'])}</pre></td></tr>\n"
        for row in rows
    )
    return (
        "<!doctype html><meta charset='utf-8'><title>Results</title><style>body{font:14px sans-serif}"
        "td,th{padding:3px 10px;text-align:left;vertical-align:top}pre{margin:0;white-space:pre-wrap}"
        ".wrong,.failed{background:#fdd}</style><table><tr><th>job</th><th>status</th><th>PSNR (dB)</th>"
        f"<th>seconds</th><th></th></tr>\n{body}</table>\n"
    )
