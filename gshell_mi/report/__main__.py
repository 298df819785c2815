"""``python -m gshell_mi.report``: a fit on one self-contained page."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..command_line import run_command
from .report import ReportConfig, write_report


@dataclass(frozen=True)
class _Arguments:
    folder: tyro.conf.Positional[Path]
    """Folder of a finished fit; report.html is written into it."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant: llvm_ad_rgb (CPU) or cuda_ad_rgb (NVIDIA GPU)."""
    config: Annotated[ReportConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=ReportConfig)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run_command(
        "report",
        "Write report.html of a fit: one page that needs no network.",
        _Arguments,
        _report,
        arguments,
    )


def _report(given: _Arguments) -> None:
    print(write_report(given.folder, given.config))


if __name__ == "__main__":
    sys.exit(main())
