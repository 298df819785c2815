"""``python -m gshell_mi.fit SCENE.xml``: reconstruct an object from posed images."""

from __future__ import annotations

import dataclasses
import itertools
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..command_line import run_command
from ..export import can_resume
from ..wording import counted
from .config import EFFORTS, Effort, FitConfig, default_output
from .flags import check_flags


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
    """Replace an earlier fit in the output folder, once the new one is complete; other files are left
    alone."""
    effort: Effort = "normal"
    """How much work the fit is. preview is a rough result in about a minute: a coarser lattice, fewer steps
    and samples, no refinement, no radiance volume, no mesh.glb or report.html. thorough takes twice as many
    steps of every stage, and ends on twice as many cells per side if it starts from a radiance volume. What
    else is given on the command line still counts."""
    no_report: bool = False
    """Leave out mesh.glb and report.html, which take some seconds."""
    quiet: bool = False
    """No progress bars."""
    viewer: bool = False
    """Show the fit in the browser while it runs; needs the extra: pip install 'gshell_mi[viewer]'."""
    viewer_port: int = 8080
    """Port of --viewer; if it is taken, the next one that is free."""
    config: Annotated[FitConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=FitConfig)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    # Other defaults, which the rest of the words are parsed against.
    effort = _effort(words)
    default = _Arguments(scene=tyro.MISSING, effort=effort, config=EFFORTS[effort])
    return run_command(
        "fit",
        "Reconstruct an open or closed surface, its material and its light.",
        _Arguments,
        _fit,
        arguments,
        default=default,
        interrupted=_how_to_continue,
        check=check_flags,
    )


def _effort(words: list[str]) -> Effort:
    """The effort that a command names; what is none is told of when the words are parsed."""
    named = [following for word, following in itertools.pairwise([*words, ""]) if word == "--effort"]
    named += [word.removeprefix("--effort=") for word in words if word.startswith("--effort=")]
    efforts: dict[str, Effort] = {effort: effort for effort in EFFORTS}
    return efforts.get(named[-1] if named else "", "normal")


def _fit(given: _Arguments) -> None:
    # Only now, as plugins and types exist per variant.
    from ..export.views import scores_line
    from ..viewer import Viewer
    from .api import fit_scene

    with ExitStack() as stack:
        viewer = None
        if given.viewer:
            viewer = stack.enter_context(Viewer(given.viewer_port))
            print(f"live view: {viewer.url}", file=sys.stderr)
        report = not (given.no_report or given.effort == "preview")
        result = fit_scene(
            given.scene,
            given.output,
            targets=given.targets,
            config=given.config,
            resume=given.resume,
            overwrite=given.overwrite,
            report=report,
            quiet=given.quiet,
            observer=viewer,
        )
    counts = result.metrics["counts"]
    print(
        f"{result.output}: {counts['vertices']} vertices, {counts['faces']} faces, "
        f"{counted(counts['boundary_loops'], 'boundary loop')}, "
        f"{counted(counts['components'], 'component')}, "
        f"{result.metrics['psnr_training']:.2f} dB on the training views, "
        f"{result.metrics['seconds']['total']:.0f} s"
    )
    if not report and not given.quiet:
        print(f"gshell-report {result.output} makes mesh.glb and report.html of it", file=sys.stderr)
    if "held_out" in result.metrics:
        print(f"held-out views: {scores_line(result.metrics['held_out'])}")
    if "held_out_laid" in result.metrics:
        print(f"the same, with cameras laid on the result: {scores_line(result.metrics['held_out_laid'])}")


def _how_to_continue(given: _Arguments) -> str:
    output = given.output or default_output(given.scene)
    if not can_resume(output):
        return "Interrupted before the first checkpoint; start it again."
    return f"Interrupted; continue with --resume (the last checkpoint is in '{output}')."


if __name__ == "__main__":
    sys.exit(main())
