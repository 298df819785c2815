"""``python -m gshell_mi.turntable``: once around a fitted object, as MP4 and GIF."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from ..bars import Bars
from ..command_line import run_command
from .turntable import TurntableConfig, render_turntable
from .video import write_video


@dataclass(frozen=True)
class _Arguments:
    folder: tyro.conf.Positional[Path]
    """Folder of a finished fit."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """The MP4; the GIF of the same name comes beside it. Earlier ones of this command are replaced. Default:
    turntable.mp4 in the fit's folder."""
    envmap: Path | None = None
    """Environment map (EXR, latitude-longitude) to light the object with instead of the fitted light."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant: llvm_ad_rgb (CPU) or cuda_ad_rgb (NVIDIA GPU)."""
    quiet: bool = False
    """No progress bar."""
    config: Annotated[TurntableConfig, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=TurntableConfig
    )


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run_command(
        "turntable", "Render a turntable of a fitted object.", _Arguments, _turntable, arguments
    )


def _turntable(given: _Arguments) -> None:
    frames = render_turntable(given.folder, given.config, envmap=given.envmap)
    columns = (TextColumn("turntable"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bars(*columns, quiet=given.quiet) as progress:
        tracked = progress.each(frames, given.config.frames)
        files = write_video(tracked, given.output or given.folder / "turntable.mp4", given.config.fps)
    print(*files, sep="\n")


if __name__ == "__main__":
    sys.exit(main())
