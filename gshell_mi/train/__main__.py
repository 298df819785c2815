"""``python -m gshell_mi.train``: a generative model learns a data set of open surfaces."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..command_line import run_command
from ..errors import UserError
from ..generation.own_process import require_torch


@dataclass(frozen=True)
class _Arguments:
    data_set: tyro.conf.Positional[Path]
    """Folder that python -m gshell_mi.dataset wrote."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder of the model. A training that was cut off goes on."""
    model: str = "blocks"
    """blocks: flow matching on the blocks near the surface; unet: the dense reference."""
    size: str = "S"
    """XS, S (CPU), M or L (GPU)."""
    minutes: float = 90.0
    """How long to train, all runs of this training together."""
    steps: int | None = None
    """Number of steps instead of minutes; the model is then the same on every run on a CPU."""
    batch: int = 32
    """Objects per step, and per process under torchrun."""
    rate: float = 5e-4
    """Learning rate after the warm-up."""
    components: int = 128
    """Of blocks: principal components that each keeps."""
    seed: int = 0
    """Of weights, order and noise."""
    device: str = "auto"
    """cpu, cuda, or auto: cuda if there is one."""
    pictures: int = 4
    """How often samples are drawn as it goes."""
    quiet: bool = False
    """No progress bar."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run_command("train", "Train a generative model.", _Arguments, _train, arguments,
                       interrupted=lambda given: f"Interrupted; run the same command again to go on with "
                                                 f"'{given.output}'.")


def _train(given: _Arguments) -> None:
    if not given.data_set.exists():
        raise UserError(f"'{given.data_set}' does not exist; check the path.")
    if given.output is None:
        raise UserError("Nothing says where the model goes; name a folder with -o.")
    from ..generation.checks import check_choice, check_positive

    check_choice("--model", given.model, ("blocks", "unet"))
    check_choice("--size", given.size, ("XS", "S", "M", "L"))
    check_choice("--device", given.device, ("auto", "cpu", "cuda"))
    check_positive("--minutes", given.minutes)
    check_positive("--batch", given.batch)
    check_positive("--rate", given.rate)
    check_positive("--components", given.components)
    if given.steps is not None:
        check_positive("--steps", given.steps)
    require_torch()
    from ..generation.training import TrainConfig, train

    config = TrainConfig(given.model, given.size, given.minutes, given.steps, given.batch, given.rate,
                         given.seed, given.device, given.pictures, given.components)
    print(f"{given.output}: {train(given.data_set, given.output, config, quiet=given.quiet)}")


if __name__ == "__main__":
    sys.exit(main())
