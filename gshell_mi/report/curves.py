"""Curves of a fit's log as SVG."""

from __future__ import annotations

import json
from html import escape
from pathlib import Path

import numpy as np

_WIDTH, _HEIGHT = 420, 180
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 10, 22, 24
_COLORS = ("#c2571a", "#3a6ea5", "#4f8a5b", "#8a5aa5", "#777777", "#b8930f", "#2a9d9d")

#: Rows of the legend: their height, and the characters that fit into one.
_ROW, _CHARACTERS = 14, 70


def curves(log: Path) -> list[str]:
    """One SVG per quantity: the losses of each stage on a logarithmic axis, and PSNR, with running means.

    There are none without a log.

    Lines that no fit wrote are left out, and names are escaped.
    """
    if not log.is_file():
        return []
    stages: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
        entry = _entry(line)
        if entry is None:
            continue
        stage = stages.setdefault(entry["stage"], {})
        for name, value in entry.items():
            if name not in ("stage", "iteration", "seconds") and _is_number(value):
                stage.setdefault(name, []).append((entry["iteration"], value))
    drawings = []
    for stage, series in stages.items():
        losses = {name: values for name, values in series.items() if name != "psnr"}
        drawings.append(_plot(f"{stage}: losses", losses, logarithmic=True))
        if "psnr" in series:
            drawings.append(_plot(f"{stage}: PSNR of the steps' pixels (dB)", {"psnr": series["psnr"]}))
    return drawings


def _entry(line: str) -> dict | None:
    """One step of the log; None if the line holds none."""
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(entry, dict) or not isinstance(entry.get("stage"), str):
        return None
    return entry if _is_number(entry.get("iteration")) else None


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def _plot(title: str, series: dict[str, list[tuple[int, float]]], *, logarithmic: bool = False) -> str:
    points = {}
    for name, values in series.items():
        x, y = (np.array(column, float) for column in zip(*values, strict=True))
        keep = np.isfinite(y) & ((y > 0) if logarithmic else True)
        if keep.any():
            points[name] = (x[keep], np.log10(y[keep]) if logarithmic else y[keep])
    if not points:
        return ""
    x_low, x_high = (f(np.concatenate([x for x, _ in points.values()])) for f in (np.min, np.max))
    # A loss that starts from nothing would press all others together.
    told = [y[len(y) // 2 :] if logarithmic else y for _, y in points.values()]
    y_low = min(y.min() for y in told)
    y_high = max(y.max() for _, y in points.values())
    x_span, y_span = max(x_high - x_low, 1), max(y_high - y_low, 1e-6)
    across = lambda x: _LEFT + (x - x_low) / x_span * (_WIDTH - _LEFT - _RIGHT)  # noqa: E731
    down = lambda y: _TOP + (y_high - np.maximum(y, y_low)) / y_span * (_HEIGHT - _TOP - _BOTTOM)  # noqa: E731
    legend = _legend(list(points)) if len(points) > 1 else []
    height = _HEIGHT + _ROW * len(legend)
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="{escape(title)}">',
        f'<text x="{_LEFT}" y="14" class="title">{escape(title)}</text>',
    ]
    for y in np.linspace(y_low, y_high, 4):
        label = f"{10**y:.2g}" if logarithmic else f"{y:.3g}"
        parts.append(
            f'<path class="grid" d="M{_LEFT} {down(y):.1f}H{_WIDTH - _RIGHT}"/>'
            f'<text x="{_LEFT - 6}" y="{down(y) + 4:.1f}" text-anchor="end">{label}</text>'
        )
    for x in (x_low, x_high):
        parts.append(f'<text x="{across(x):.1f}" y="{_HEIGHT - 8}" text-anchor="middle">{x:.0f}</text>')
    for number, (name, (x, y)) in enumerate(points.items()):
        color = _COLORS[number % len(_COLORS)]
        smooth = _running_mean(y)
        lines = [(smooth, "")] if (smooth == y).all() else [(y, ' opacity="0.3"'), (smooth, "")]
        for values, look in lines:
            path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across(x), down(values), strict=True))
            told = f"<title>{escape(name)}</title>"
            parts.append(f'<polyline points="{path}" stroke="{color}"{look}>{told}</polyline>')
    return "".join([*parts, *legend, "</svg>"])


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Over a tenth of all: steps look at different views, and jump. A few values stay as they are."""
    reach = len(values) // 20
    if not reach:
        return values
    sums = np.cumsum(np.insert(values, 0, 0))
    index = np.arange(len(values))
    first, end = np.maximum(index - reach, 0), np.minimum(index + reach + 1, len(values))
    return (sums[end] - sums[first]) / (end - first)


def _legend(names: list[str]) -> list[str]:
    """Rows of names in the colours of their lines."""
    rows: list[list[str]] = [[]]
    used = 0
    for number, name in enumerate(names):
        if used and used + len(name) > _CHARACTERS:
            rows.append([])
            used = 0
        color = _COLORS[number % len(_COLORS)]
        rows[-1].append(f'<tspan dx="10" fill="{color}">{escape(name.replace("_", " "))}</tspan>')
        used += len(name) + 2
    return [
        f'<text x="{_WIDTH / 2}" y="{_HEIGHT - 8 + _ROW * (row + 1)}" text-anchor="middle">'
        f"{''.join(tspans)}</text>"
        for row, tspans in enumerate(rows)
    ]
