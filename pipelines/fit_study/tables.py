"""Markdown tables of outcomes."""

from __future__ import annotations

from .trials import Outcome

#: Heading and what it shows of the scores.
_COLUMNS = {
    "loops": lambda s: _of(s["mesh"]["boundary_loops"]),
    "pin-holes": lambda s: str(s["mesh"]["pinholes"]["found"]),
    "components": lambda s: _of(s["mesh"]["components"]),
    "non-manifold": lambda s: str(s["mesh"]["nonmanifold_edges"]["found"]),
    "rim": lambda s: _ratio(s["mesh"]["boundary_length"]),
    "chamfer %": lambda s: f"{s['mesh']['chamfer']:.3f}",
    "F-score": lambda s: f"{s['mesh']['f_score']:.3f}",
    "novel dB": lambda s: f"{s['mean']['psnr']:.2f}",
    "mask IoU": lambda s: f"{s['mean']['mask_iou']:.4f}",
}

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
    names = list(_COLUMNS)
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


def _cells(outcome: Outcome) -> list[str]:
    if outcome.error:
        reason = outcome.error.split(" in '")[0]
        return [f"failed: {reason}"] + [""] * len(_COLUMNS)
    seconds = "-" if outcome.cpu_seconds is None else f"{outcome.cpu_seconds:.0f}"
    return [show(outcome.scores) for show in _COLUMNS.values()] + [seconds]


def _of(count: dict) -> str:
    return f"{count['found']} / {count['reference']}"


def _ratio(length: dict) -> str:
    return f"{length['found'] / length['reference']:.2f}" if length["reference"] else "-"
