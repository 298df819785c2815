"""``python -m gshell_mi.export OUT``: a fitted object for other programs."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..doctor import ensure_variant
from ..errors import UserError
from .asset import AssetConfig, write_asset


@dataclass(frozen=True)
class _Arguments:
    output: tyro.conf.Positional[Path]
    """Folder of a finished fit."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant: llvm_ad_rgb (CPU) or cuda_ad_rgb (NVIDIA GPU)."""
    config: Annotated[AssetConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=AssetConfig)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    try:
        given = tyro.cli(_Arguments, args=arguments, prog="python -m gshell_mi.export",
                         description="Write the object of a fit for Blender, game engines and simulators.",
                         config=(tyro.conf.FlagCreatePairsOff,))
        ensure_variant(given.variant)
        report = write_asset(given.output, given.config)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    atlas = f"{report['charts']} charts" if report["charts"] else "colours at the vertices, no UV atlas"
    print(f"{given.output / 'mesh.glb'}: {report['faces']} faces, {atlas}")
    if "remeshed_faces" in report:
        print(f"{given.output / 'remeshed.ply'}: {report['remeshed_faces']} faces, worst quality "
              f"{report['remeshed_min_quality']:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
