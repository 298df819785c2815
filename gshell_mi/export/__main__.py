"""``python -m gshell_mi.export OUT``: a fitted object for other programs."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..command_line import run_command
from .asset import NO_ATLAS, AssetConfig, write_asset


@dataclass(frozen=True)
class _Arguments:
    output: tyro.conf.Positional[Path]
    """Folder of a finished fit."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant: llvm_ad_rgb (CPU) or cuda_ad_rgb (NVIDIA GPU)."""
    config: Annotated[AssetConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=AssetConfig)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run_command(
        "export",
        "Write the object of a fit for Blender, game engines and simulators.",
        _Arguments,
        _export,
        arguments,
    )


def _export(given: _Arguments) -> None:
    report = write_asset(given.output, given.config)
    print(f"{given.output / 'mesh.glb'}: {report['faces']} faces, {report['charts']} charts")
    if not report["charts"] and given.config.unwrap_seconds:
        print(f"warning: {NO_ATLAS}", file=sys.stderr)
    if "remeshed_faces" in report:
        print(
            f"{given.output / 'remeshed.ply'}: {report['remeshed_faces']} faces, worst quality "
            f"{report['remeshed_min_quality']:.3f}"
        )


if __name__ == "__main__":
    sys.exit(main())
