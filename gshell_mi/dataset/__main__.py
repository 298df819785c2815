"""``python -m gshell_mi.dataset``: meshes, fits or generated garments become a data set to learn from."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..command_line import run_command
from ..errors import UserError

#: Beyond, the list of them alone fills memory.
_MOST_GARMENTS = 1_000_000


@dataclass(frozen=True)
class _Arguments:
    sources: tyro.conf.Positional[tuple[Path, ...]] = field(default_factory=tuple)
    """Mesh files, folders of them, and folders of fits. The first folder below is the class."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder of the data set. One that a run left unfinished is gone on with."""
    garments: int = 0
    """Generated garments to add."""
    seed: int = 0
    """Of the generated garments."""
    side: int = 64
    """Vertices per side of the grid; a multiple of 8."""
    held_out: float = 0.1
    """Fraction of the objects that are kept for tests; drawn by their names."""
    max_chamfer: float = 0.5
    """Objects whose fields are farther from them are refused, in per cent of their size."""
    processes: int = 1
    """How many objects are converted at once."""
    quiet: bool = False
    """No progress bar."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant: llvm_ad_rgb (CPU) or cuda_ad_rgb (NVIDIA GPU)."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run_command(
        "dataset",
        "Make a data set of open surfaces.",
        _Arguments,
        _make,
        arguments,
        interrupted=lambda given: f"Interrupted; run the same command again to go on with '{given.output}'.",
    )


def _make(given: _Arguments) -> None:
    from ..generation.checks import check_positive
    from ..generation.making import make_data_set

    for place in given.sources:
        if not place.exists():
            raise UserError(f"'{place}' does not exist; check the path.")
    if given.output is None:
        raise UserError("Nothing says where the data set goes; name a folder with -o.")
    if given.garments < 0 or not (given.sources or given.garments):
        raise UserError(
            "There is nothing to make a data set of; name folders of meshes, or a number of --garments."
        )
    if given.garments > _MOST_GARMENTS:
        raise UserError(f"--garments must be at most {_MOST_GARMENTS}, not {given.garments}.")
    if given.seed < 0:
        raise UserError(f"--seed must not be negative, but is {given.seed}.")
    check_positive("--max-chamfer", given.max_chamfer)
    if given.side % 8 or not 16 <= given.side <= 256:
        raise UserError(f"--side must be a multiple of 8 from 16 to 256, not {given.side}.")
    if not 0 <= given.held_out < 1:
        raise UserError(f"--held-out must be at least 0 and less than 1, not {given.held_out:g}.")
    if given.processes < 1:
        raise UserError(f"--processes must be at least 1, not {given.processes}.")
    told = make_data_set(
        given.output,
        list(given.sources),
        garments=given.garments,
        seed=given.seed,
        side=given.side,
        held_out=given.held_out,
        most=given.max_chamfer,
        processes=given.processes,
        variant=given.variant,
        quiet=given.quiet,
    )
    print(told)


if __name__ == "__main__":
    sys.exit(main())
