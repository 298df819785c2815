"""What the commands of the studies have in common."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from gshell_mi.doctor import ensure_variant
from gshell_mi.errors import UserError
from gshell_mi.fit import FitConfig

from .settings import parsed_settings
from .trials import Trial, run_trials

#: Makes the page of (scenes, shared settings, folder of the fits, options to quote).
Page = Callable[[list[Path], FitConfig, Path, str], str]


def add_common_arguments(
    parser: argparse.ArgumentParser, scenes: list[Path], output: str, page: Path
) -> None:
    """Scenes, shared settings and where things are written; what follows the parser are defaults."""
    add_scene_arguments(parser, scenes)
    parser.add_argument(
        "-o", "--output", type=Path, default=Path(output), help="folder of the fits and their scores"
    )
    parser.add_argument("--page", type=Path, default=page, help="the Markdown file to write")
    parser.add_argument("--page-only", action="store_true", help="make no fit, write what there is")
    parser.add_argument("--bars", action="store_true", help="show the progress of every stage of every fit")


def add_scene_arguments(parser: argparse.ArgumentParser, scenes: list[Path]) -> None:
    """Scenes, by default these, and settings that their fits share."""
    parser.add_argument(
        "scenes",
        nargs="*",
        type=Path,
        default=scenes,
        metavar="SCENE.xml",
        help=f"default: {', '.join(scene.stem for scene in scenes)}",
    )
    parser.add_argument(
        "--set",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        dest="settings",
        help="settings of all fits instead of the defaults",
    )


def run_study(arguments: argparse.Namespace, trials: Callable[[FitConfig], list[Trial]], page: Page) -> int:
    """Runs the trials of the shared settings, writes the page after each; returns the exit code."""
    try:
        base = parsed_settings(arguments.settings)
        options = f" --set {' '.join(arguments.settings)}" if arguments.settings else ""

        def write() -> None:
            arguments.page.write_text(page(arguments.scenes, base, arguments.output, options))

        if not arguments.page_only:
            ensure_variant()
            for _ in run_trials(trials(base), arguments.output, quiet=not arguments.bars):
                write()
        write()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Interrupted; the same command goes on from here.", file=sys.stderr)
        return 130
    return 0
