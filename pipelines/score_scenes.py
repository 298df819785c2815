"""Fits scenes with default settings, scores them against their truth and writes the scores as a page.

    python pipelines/score_scenes.py [SCENE.xml ...] [--set NAME=VALUE ...]

It runs, goes on after an interruption and scores as ``ablation.py`` does.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY / "pipelines"), str(REPOSITORY)]

from fit_study.command import add_common_arguments, run_study  # noqa: E402
from fit_study.settings import as_flags, non_default  # noqa: E402
from fit_study.tables import LEGEND, table  # noqa: E402
from fit_study.trials import Trial, load_outcome  # noqa: E402

from gshell_mi.fit import FitConfig  # noqa: E402

NOTES = Path(__file__).with_name("scenes_notes.md")

_INTRODUCTION = """\
# The scenes and their scores

Made by `python pipelines/score_scenes.py{options}`: one fit of each scene. {shared}

{legend}

"""


def page(scenes: list[Path], base: FitConfig, output: Path, options: str) -> str:
    """The page of the fits that exist on disk."""
    shared = as_flags(non_default(base))
    shared = f"Settings: `{shared}`, the rest defaults." if shared else "All settings are defaults."
    outcomes = [load_outcome(Trial(scene, "default", base), output) for scene in scenes]
    rows = [(None, scene.stem, outcome) for scene, outcome in zip(scenes, outcomes, strict=True)]
    text = _INTRODUCTION.format(options=options, shared=shared, legend=LEGEND) + table(rows, "scene")
    if missing := [scene.stem for scene, outcome in zip(scenes, outcomes, strict=True) if outcome is None]:
        text += f"\nNot measured: {', '.join(missing)}.\n"
    if NOTES.exists():
        text += "\n" + NOTES.read_text()
    return text


def main(given: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_common_arguments(
        parser, sorted((REPOSITORY / "scenes").glob("*.xml")), "out/scenes", REPOSITORY / "docs" / "scenes.md"
    )
    arguments = parser.parse_args(given)

    def trials(base: FitConfig) -> list[Trial]:
        return [Trial(scene, "default", base) for scene in arguments.scenes]

    return run_study(arguments, trials, page)


if __name__ == "__main__":
    sys.exit(main())
