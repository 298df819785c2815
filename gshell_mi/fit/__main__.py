"""``python -m gshell_mi.fit SCENE.xml``: reconstruct an object from posed images."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..doctor import ensure_variant
from ..errors import UserError
from .config import FitConfig, default_output


@dataclass(frozen=True)
class _Arguments:
    scene: tyro.conf.Positional[Path]
    """The fit scene: a Mitsuba XML file with one gshell shape and the training sensors."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder for the results; default: out/<name of the scene>."""
    targets: Path | None = None
    """Folder of the target images <sensor id>.exr; default: the folder beside the scene with its name."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant: llvm_ad_rgb (CPU) or cuda_ad_rgb (NVIDIA GPU)."""
    resume: bool = False
    """Continue an interrupted fit in the output folder."""
    overwrite: bool = False
    """Replace an earlier fit in the output folder."""
    no_report: bool = False
    """Leave out mesh.glb and report.html, which take some seconds."""
    quiet: bool = False
    """No progress bars."""
    config: Annotated[FitConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=FitConfig)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    try:
        given = tyro.cli(_Arguments, args=arguments, prog="python -m gshell_mi.fit",
                         description="Reconstruct an open or closed surface, its material and its light.",
                         config=(tyro.conf.FlagCreatePairsOff,))
        ensure_variant(given.variant)
        # Only now, as plugins and types exist per variant.
        from .run import fit_scene

        result = fit_scene(given.scene, given.output, targets=given.targets, config=given.config,
                           resume=given.resume, overwrite=given.overwrite, report=not given.no_report,
                           quiet=given.quiet)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        output = given.output or default_output(given.scene)
        print(f"Interrupted; continue with --resume (the last checkpoint is in '{output}').", file=sys.stderr)
        return 130
    counts = result.metrics["counts"]
    print(f"{result.output}: {counts['vertices']} vertices, {counts['faces']} faces, "
          f"{counts['boundary_loops']} boundary loops, {counts['components']} components, "
          f"{result.metrics['psnr_training']:.2f} dB on the training views, "
          f"{result.metrics['seconds']['total']:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
