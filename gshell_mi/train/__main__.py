"""``python -m gshell_mi.train``: a generative model learns a data set of open surfaces."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..command_line import run_command
from ..errors import UserError
from ..generation.model_config import MODELS, SIZES
from ..generation.own_process import require_torch
from ..generation.train_config import TrainConfig


@dataclass(frozen=True)
class _Arguments:
    data_set: tyro.conf.Positional[Path]
    """Folder that python -m gshell_mi.dataset wrote."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder of the model. A training that was cut off goes on."""
    quiet: bool = False
    """No progress bar."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run_command(
        "train",
        "Train a generative model.",
        _Arguments,
        _train,
        arguments,
        interrupted=lambda given: f"Interrupted; run the same command again to go on with '{given.output}'.",
    )


def _train(given: _Arguments) -> None:
    if not given.data_set.exists():
        raise UserError(f"'{given.data_set}' does not exist; check the path.")
    if given.output is None:
        raise UserError("Nothing says where the model goes; name a folder with -o.")
    from ..generation.checks import check_choice, check_positive

    config = given.config
    check_choice("--model", config.model, MODELS)
    check_choice("--size", config.size, tuple(SIZES))
    check_choice("--device", config.device, ("auto", "cpu", "cuda"))
    check_positive("--minutes", config.minutes)
    check_positive("--batch", config.batch)
    check_positive("--rate", config.rate)
    if config.steps is not None:
        check_positive("--steps", config.steps)
    require_torch()
    from ..generation.training import train

    print(f"{given.output}: {train(given.data_set, given.output, config, quiet=given.quiet)}")


if __name__ == "__main__":
    sys.exit(main())
