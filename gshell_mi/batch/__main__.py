"""``python -m gshell_mi.batch``: many commands of this package, on one machine or on a Ray cluster."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..command_line import run_command
from ..errors import UserError


@dataclass(frozen=True)
class _Arguments:
    jobs: tyro.conf.Positional[Path]
    """File with a JSON object per line: name, command, arguments, cpus, gpus, memory_gib."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder of the list and the page of results. What is done there is not done again."""
    results: str | None = None
    """Folder or fsspec URL for the jobs' files, which all machines reach; default: jobs in the output."""
    address: str | None = None
    """Of a Ray cluster, such as ray://head:10001; default: one on this machine, for as long as it runs."""
    retries: int = 2
    """How often a job is tried again after its machine or itself failed."""
    cpus: float | None = None
    """Of the cluster on this machine; default: its cores."""
    quiet: bool = False
    """No progress bar."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run_command(
        "batch",
        "Run many commands.",
        _Arguments,
        _batch,
        arguments,
        interrupted=lambda given: f"Interrupted; run the same command again to go on with '{given.output}'.",
    )


def _batch(given: _Arguments) -> None:
    from .batch import run_batch

    if not given.jobs.exists():
        raise UserError(f"'{given.jobs}' does not exist; check the path.")
    if given.output is None:
        raise UserError("Nothing says where the results go; name a folder with -o.")
    if given.retries < 0:
        raise UserError(f"--retries must not be negative, but is {given.retries}.")
    if given.cpus is not None and not given.cpus >= 1:
        raise UserError(f"--cpus must be at least 1, not {given.cpus:g}.")
    print(
        run_batch(
            given.jobs,
            given.output,
            results=given.results,
            address=given.address,
            retries=given.retries,
            cpus=given.cpus,
            quiet=given.quiet,
        )
    )


if __name__ == "__main__":
    sys.exit(main())
