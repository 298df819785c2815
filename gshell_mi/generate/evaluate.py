"""``python -m gshell_mi.generate.evaluate``: scores of samples against the held-out part of a data set."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

from ..command_line import run_command
from ..errors import UserError
from ..evaluation.scores_file import check_scores_file, write_scores

_MEANINGS = {
    "mmd": "mean distance from a true shape to the nearest sample",
    "mmd_boundary": "the same of points along their boundaries",
    "coverage": "true shapes that are nearest to some sample",
    "nearest_neighbour_accuracy": "0.5: nothing tells samples from true shapes",
    "jsd": "divergence of where points lie, in bits",
    "nearest_training": "mean distance from a sample to the nearest training shape",
    "nearest_training_of_true": "the same of held-out shapes: much less above is memory",
    "loops_as_class": "samples with as many loops as some object of their class",
    "one_component": "samples in one piece",
    "self_intersecting": "samples that go through themselves",
}


@dataclass(frozen=True)
class _Arguments:
    samples: tyro.conf.Positional[Path]
    """Folder that python -m gshell_mi.generate wrote."""
    data_set: tyro.conf.Positional[Path]
    """The data set that the model was trained on."""
    points: int = 512
    """Of each shape, up to 2048."""
    emd: int = 32
    """Shapes of each set for the earth mover's distance; 0 for none."""
    json: Path | None = None
    """File for the scores; one of an earlier evaluation is replaced."""
    quiet: bool = False
    """No progress bar."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant: llvm_ad_rgb (CPU) or cuda_ad_rgb (NVIDIA GPU)."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run_command(
        "generate.evaluate", "Score samples against a data set.", _Arguments, _evaluate, arguments
    )


def _evaluate(given: _Arguments) -> None:
    from ..doctor import ensure_variant
    from ..generation.data_set import DataSet
    from ..generation.evaluated import evaluate, read_samples

    if not given.samples.exists():
        raise UserError(f"'{given.samples}' does not exist; check the path.")
    if not 16 <= given.points <= 2048:
        raise UserError(f"--points must be from 16 to 2048, not {given.points}.")
    if given.emd < 0:
        raise UserError(f"--emd must not be negative, but is {given.emd}.")
    if given.json:
        check_scores_file(given.json)
    data = DataSet.open(given.data_set)
    ensure_variant(given.variant)
    scores = evaluate(
        read_samples(given.samples, given.points), data, points=given.points, emd=given.emd, quiet=given.quiet
    )
    if given.json:
        write_scores(given.json, scores)
    table = Table("score", "", "")
    for name, value in scores.items():
        shown = "" if value is None else f"{value:.4f}" if isinstance(value, float) else str(value)
        table.add_row(name, shown, _MEANINGS.get(name, ""))
    Console(highlight=False).print(table)


if __name__ == "__main__":
    sys.exit(main())
