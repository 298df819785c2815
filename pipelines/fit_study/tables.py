"""Markdown tables of outcomes."""

from __future__ import annotations

from .expectations import FIGURES
from .trials import Outcome

#: Figures that are shown with the truth's.
_OF_THE_TRUTH = ("boundary_loops", "components")

#: Figures of the mesh that tell what a stage has done to it.
_OF_STAGES = ("boundary_loops", "pinholes", "components", "rim", "chamfer", "f_score")

LEGEND = """\
Loops and components are *found / true*; a boundary shorter than 5 % of the diagonal is a pin-hole and no
loop. *Rim* is the length of all boundaries over that of the truth. Chamfer is the mean of both directions in
per cent of the truth's bounding box diagonal (two samplings of one surface are 0.1 apart); the F-score counts
what lies within 0.5 % of it. *Novel* is the mean PSNR of twelve views that no fit saw. CPU seconds are those
of the fit on all threads together: unlike wall time, they depend little on what else the machine does."""


def table(rows: list[tuple[str | None, str, Outcome | None]], first: str) -> str:
    """A table of (group, label, outcome): a group is a heading of its own line where it changes.

    ``first`` is the heading of the labels. Outcomes that are None are left out; those that were made by
    another version of the code than the first are marked.
    """
    code = next((outcome.code for _, _, outcome in rows if outcome), None)
    marked = False
    names = [figure.title for figure in FIGURES.values()]
    lines = [f"| {first} | {' | '.join(names)} | CPU s |", "|---" * (len(names) + 2) + "|"]
    shown = None
    for group, label, outcome in rows:
        if outcome is None:
            continue
        if group and group != shown:
            lines.append(f"| **{group}** |" + " |" * (len(names) + 1))
            shown = group
        if outcome.code != code:
            label, marked = f"{label} †", True
        lines.append(f"| {label} | {' | '.join(_cells(outcome))} |")
    if marked:
        lines += ["", "† Fitted with another version of the code than the first row."]
    return "\n".join(lines) + "\n"


def stages_table(outcome: Outcome) -> str:
    """A table of the surface after each of a fit's stages; empty if that was not kept."""
    if not outcome.stages:
        return ""
    titles = [FIGURES[name].title for name in _OF_STAGES]
    lines = [f"| after | s | {' | '.join(titles)} |", "|---" * (len(titles) + 2) + "|"]
    before = None
    for stage, told in outcome.stages.items():
        cells = [""] * len(titles)
        if told["mesh"] == before:
            cells[0] = "same"
        elif told["mesh"]:
            cells = [_cell(name, told) for name in _OF_STAGES]
        lines.append(f"| *{stage}* | {told['seconds']:.0f} | {' | '.join(cells)} |")
        before = told["mesh"]
    return "\n".join(lines) + "\n"


def _cells(outcome: Outcome) -> list[str]:
    if outcome.error:
        reason = outcome.error.split(" in '")[0]
        return [f"failed: {reason}"] + [""] * len(FIGURES)
    seconds = "-" if outcome.cpu_seconds is None else f"{outcome.cpu_seconds:.0f}"
    return [_cell(name, outcome.scores) for name in FIGURES] + [seconds]


def _cell(name: str, scores: dict) -> str:
    if name in _OF_THE_TRUTH:
        count = scores["mesh"][name]
        return f"{count['found']} / {count['reference']}"
    figure = FIGURES[name]
    return figure.text(figure.read(scores))
