"""``python -m gshell_mi.report``: a fit on one self-contained page."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..doctor import ensure_variant
from ..errors import UserError
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
    try:
        given = tyro.cli(_Arguments, args=arguments, prog="python -m gshell_mi.report",
                         description="Write report.html of a fit: one page that needs no network.")
        ensure_variant(given.variant)
        print(write_report(given.folder, given.config))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
