"""``python -m gshell_mi.generate``: new open meshes from a trained model."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..command_line import run_command
from ..errors import UserError
from ..generation.checks import check_choice, check_positive
from ..generation.model_config import SHIPPED
from ..generation.own_process import require_torch


@dataclass(frozen=True)
class _Arguments:
    model: tyro.conf.Positional[Path | None] = None
    """Folder that python -m gshell_mi.train wrote. Default: the package's own model of garments."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder for the meshes; earlier ones are replaced. Default: generated, in MODEL or here."""
    count: Annotated[int, tyro.conf.arg(aliases=["-n"])] = 16
    """How many."""
    kind: Annotated[str | None, tyro.conf.arg(name="class")] = None
    """Class of all of them; default: the model's classes in turn."""
    seed: int = 0
    """Of the first sample; the others count on."""
    guidance: float = 1.0
    """Weight of the class; 1 is the plain model, more is more typical."""
    steps: int = 32
    """Steps from noise to a surface."""
    interpolate: tuple[int, int] | None = None
    """Two seeds; the samples lead from one to the other, and a film of them is made."""
    near: Path | None = None
    """A fit's folder or a mesh file; the samples are variations of it."""
    strength: float = 0.5
    """Of --near: from 0, the same, to 1, anything."""
    complete: Path | None = None
    """A fit's folder; what no view of it saw is filled from the model, the rest is held fixed."""
    format: str = "ply"
    """ply or glb."""
    batch: int = 16
    """Samples at once."""
    device: str = "auto"
    """cpu, cuda, or auto: cuda if there is one."""
    quiet: bool = False
    """No progress bar."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant: llvm_ad_rgb (CPU) or cuda_ad_rgb (NVIDIA GPU)."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run_command("generate", "Sample open meshes from a model.", _Arguments, _generate, arguments)


def _generate(given: _Arguments) -> None:
    for place in (given.model, given.near, given.complete):
        if place is not None and not place.exists():
            raise UserError(f"'{place}' does not exist; check the path.")
    check_positive("--count", given.count)
    check_positive("--steps", given.steps)
    check_positive("--batch", given.batch)
    check_choice("--format", given.format, ("ply", "glb"))
    check_choice("--device", given.device, ("auto", "cpu", "cuda"))
    if not 0 <= given.strength <= 1:
        raise UserError(f"--strength must be from 0 to 1, not {given.strength:g}.")
    if sum(option is not None for option in (given.interpolate, given.near, given.complete)) > 1:
        raise UserError("--interpolate, --near and --complete exclude each other; give one of them.")
    if given.seed < 0 or min(given.interpolate or (0,)) < 0:
        raise UserError("Seeds must not be negative; give another.")
    require_torch()
    from ..generation.sampled import generate

    output = given.output or (given.model or Path()) / "generated"
    print(
        generate(
            given.model or SHIPPED,
            output,
            count=given.count,
            kind=given.kind,
            seed=given.seed,
            guidance=given.guidance,
            steps=given.steps,
            interpolate=given.interpolate,
            near=given.near,
            strength=given.strength,
            complete=given.complete,
            suffix=given.format,
            batch=given.batch,
            device=given.device,
            quiet=given.quiet,
        )
    )


if __name__ == "__main__":
    sys.exit(main())
