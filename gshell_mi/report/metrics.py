"""``metrics.json`` of a fit, read from a folder that may be anybody's."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..json_files import read_json

#: The entries that a page cannot do without, and what they are.
_NEEDED = {
    "scene": str,
    "psnr_training": float,
    "training": dict,
    "counts": dict,
    "seconds": dict,
    "versions": dict,
    "config": dict,
}

#: Those that may be missing.
_OPTIONAL = {
    "warnings": list,
    "diagnostics": dict,
    "held_out": dict,
    "held_out_laid": dict,
    "exposures": dict,
    "poses": dict,
    "light_frame": str,
}

#: Entries within them that a page takes for numbers.
_NUMBERS = {"counts": ("vertices", "faces", "boundary_loops", "components"), "seconds": ("total",)}

#: Levels of lists and objects in each other; ours have three.
_DEPTH = 8


def read_metrics(path: Path) -> dict[str, Any]:
    """The contents of the file.

    Raises:
        UserError: it is missing, no JSON, or not what a fit writes.
    """
    try:
        metrics = read_json(path)
    except (OSError, ValueError) as error:
        raise UserError(f"'{path}' is missing or no JSON; give the folder of a finished fit.") from error
    problem = _problem(metrics)
    if problem:
        raise UserError(f"'{path}' is not what a fit writes ({problem}); run the fit again.")
    return metrics


def _problem(metrics: object) -> str | None:
    if not isinstance(metrics, dict):
        return "it is no object"
    if not _is_shallow(metrics, _DEPTH):
        return "it is nested too deeply"
    for name, kind in (_NEEDED | _OPTIONAL).items():
        if name not in metrics:
            if name in _NEEDED:
                return f"'{name}' is missing"
        elif not (_is_number(metrics[name]) if kind is float else isinstance(metrics[name], kind)):
            return f"'{name}' is no {'number' if kind is float else kind.__name__}"
    for name, keys in _NUMBERS.items():
        for key in keys:
            if not _is_number(metrics[name].get(key)):
                return f"'{name}.{key}' is no number"
    for name in ("training", "held_out", "held_out_laid"):
        if name in metrics and not _are_scores(metrics[name]):
            return f"'{name}' holds no scores of views"
    if not _are_corrections(metrics):
        return "'poses' or 'exposures' holds no numbers of views"
    return None


def _are_scores(entry: dict) -> bool:
    """Whether it has ``views`` and ``mean`` as a fit writes them: numbers, and ``psnr`` always."""
    views = entry.get("views")
    if not isinstance(views, dict):
        return False
    return all(
        isinstance(scores, dict)
        and _is_number(scores.get("psnr"))
        and all(score is None or _is_number(score) for score in scores.values())
        for scores in (*views.values(), entry.get("mean"))
    )


def _are_corrections(metrics: dict) -> bool:
    """Whether what is told of poses and exposures, if anything is, is numbers by view."""
    views = metrics.get("poses", {}).get("views", {})
    if not (isinstance(views, dict) and all(isinstance(view, dict) for view in views.values())):
        return False
    stops = metrics.get("exposures", {}).get("stops", {})
    return isinstance(stops, dict) and all(
        _is_number(value) for told in (stops, *views.values()) for value in told.values()
    )


def _is_number(value: object) -> bool:
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False


def _is_shallow(value: object, depth: int) -> bool:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return depth > 0 and all(_is_shallow(part, depth - 1) for part in inner)
