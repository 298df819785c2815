"""Switches single stages of the fit off and writes what each is worth as a page.

    python pipelines/ablation.py [SCENE.xml ...] [--rows NAME ...] [--set resolution=48]

A row fits every scene with the settings of the first row but for those of one stage, or of one idea or loss
if ``--rows`` names such. Fits run one after another; a fit whose scores exist under the same settings is not
made again, and one that was interrupted goes on, so stop and start the command as you like. The mesh is
scored against the scene's ``truth.ply``, and renderings from the sensors of its ``test.xml``, which no fit
sees, against those of its ``reference.xml``. Of the fit with all stages, the surface is scored after each.
After code has changed, start with an empty ``--output``.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY / "pipelines"), str(REPOSITORY)]

from fit_study.ablation_rows import ROWS, STAGES  # noqa: E402
from fit_study.command import add_common_arguments, run_study  # noqa: E402
from fit_study.settings import as_flags, non_default  # noqa: E402
from fit_study.tables import LEGEND, stages_table, table  # noqa: E402
from fit_study.trials import Trial, load_outcome  # noqa: E402

from gshell_mi.fit import FitConfig  # noqa: E402

SCENES = [REPOSITORY / "scenes" / f"{name}.xml" for name in ("tshirt", "chair")]
NOTES = Path(__file__).with_name("stages_notes.md")

_INTRODUCTION = """\
# What each stage is worth

[fit.md](fit.md) tells how a fit works. Here are fits without one of its stages each, made by

    python pipelines/ablation.py{options}

on the scenes of this repository; all else is the same. {shared} `--rows` compares single choices within the
stages, too, and losses; `--list` names them.

{legend}

"""


def page(scenes: list[Path], base: FitConfig, output: Path, options: str) -> str:
    """The page of the rows that exist on disk."""
    shared = as_flags(non_default(base))
    shared = f"All share `{shared}`." if shared else "All other settings are defaults."
    text = _INTRODUCTION.format(options=options, shared=shared, legend=LEGEND)
    if NOTES.exists():
        text += NOTES.read_text() + "\n"
    for scene in scenes:
        rows = [
            (
                row.group,
                f"{row.says} `{as_flags(row.changes)}`" if row.changes else row.says,
                load_outcome(Trial(scene, row.name, row.config(base)), output),
            )
            for row in ROWS
        ]
        if any(outcome for *_, outcome in rows):
            text += f"## {scene.stem}\n\n{table(rows, 'what is left out')}\n"
        if rows[0][-1] and (stages := stages_table(rows[0][-1])):
            text += f"The surface after each stage of the fit with all of them, in its order:\n\n{stages}\n"
    return text.rstrip() + "\n"


def main(given: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [row.name for row in ROWS]
    add_common_arguments(parser, SCENES, "out/ablation", REPOSITORY / "docs" / "stages.md")
    parser.add_argument(
        "--rows",
        nargs="+",
        choices=names,
        metavar="NAME",
        default=[row.name for row in STAGES],
        help="these rows, default: the stages; --list shows what there is",
    )
    parser.add_argument("--list", action="store_true", help="list the rows and stop")
    arguments = parser.parse_args(given)
    if arguments.list:
        for row in ROWS:
            print(f"{row.name:<24}{row.group}: {row.says}  {as_flags(row.changes)}".rstrip())
        return 0

    def trials(base: FitConfig) -> list[Trial]:
        # Row by row, so that a run that is stopped has compared something on every scene.
        return [
            Trial(scene, row.name, row.config(base))
            for row in ROWS
            if row.name in arguments.rows
            for scene in arguments.scenes
        ]

    return run_study(arguments, trials, page)


if __name__ == "__main__":
    sys.exit(main())
