"""``python -m gshell_mi.capture SRC -o SCENE.xml``: photographs or a video to a fit scene."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..bars import Bars
from ..command_line import run_command
from ..errors import UserError
from .config import CaptureConfig


@dataclass(frozen=True)
class _Arguments:
    source: tyro.conf.Positional[Path]
    """The capture: a folder with transforms*.json (NeRF), cameras*.npz (IDR, NeuS), sparse/0 (COLMAP),
    poses_bounds.npy (LLFF) or an XML file of Mitsuba sensors; or that file; or a folder of mere photographs
    or a video, whose cameras are found (extra "colmap"). With --check but no output: a fit scene."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """The fit scene to write, ending in .xml; the targets go into the folder of its name beside it."""
    check: bool = False
    """Draw check.png into the scene's folder: cameras, box, axes and visual hull over every view. Done anyway
    where cameras or masks had to be made."""
    overwrite: bool = False
    """Replace what an earlier import wrote; other files, as photographs in its folder, are left alone."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant: llvm_ad_rgb (CPU) or cuda_ad_rgb (NVIDIA GPU)."""
    quiet: bool = False
    """No progress bar."""
    config: Annotated[CaptureConfig, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=CaptureConfig
    )


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run_command(
        "capture",
        "Turn photographs or a video into a scene for gshell_mi.fit.",
        _Arguments,
        _capture,
        arguments,
        interrupted=lambda _: (
            "Interrupted; no scene was written. Steps that were finished are not done again."
        ),
    )


def _capture(given: _Arguments) -> None:
    if given.output is None and not given.check:
        raise UserError("Nothing to do: give the scene to write with -o, or --check for a look at one.")
    made = _import(given) if given.output is not None else ()
    if given.check or made:
        _check(given.output or given.source, warn=given.output is None)


def _import(given: _Arguments) -> tuple[str, ...]:
    """What had to be made because it was not given."""
    from .run import import_capture

    with Bars(transient=True, quiet=given.quiet) as bar:
        task = bar.add_task("photographs", total=None)

        def show(what: str, done: int, count: int) -> None:
            bar.update(task, description=what, completed=done, total=count)

        assert given.output is not None
        result = import_capture(
            given.source,
            given.output,
            config=given.config,
            overwrite=given.overwrite,
            progress=lambda done, count: show("targets", done, count),
            steps=show,
        )
    _warn(result.warnings)
    low, high = (", ".join(f"{value:.3g}" for value in corner) for corner in result.box)
    print(
        f"{result.path}: {result.training} training views, {result.held_out} held out, box ({low}) to "
        f"({high})"
    )
    if result.made:
        print(f"made: {' and '.join(result.made)}")
    return result.made


def _check(scene: Path, *, warn: bool) -> None:
    from .check import check_scene

    report = check_scene(scene)
    if warn:  # an import has said the same already
        _warn(report.warnings)
    print(f"{report.picture}: look at it before the fit")


def _warn(warnings: tuple[str, ...]) -> None:
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
