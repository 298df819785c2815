"""Stored results of fits, and the bands that later fits must stay in."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gshell_mi.errors import UserError
from gshell_mi.files import replacing
from gshell_mi.json_files import read_json_object

#: (least, most) of a figure; None is no bound.
Band = tuple[float | None, float | None]


@dataclass(frozen=True)
class Figure:
    """A number that tells how good a fit is."""

    title: str
    """As in the tables' heading."""
    read: Callable[[dict], float | None]
    """From the scores of ``compare_fit``; None where the truth has no such thing."""
    band: Callable[[float, dict], Band]
    """From a stored number, and scores for the truth's: what is no worse, but for noise."""
    digits: int = 0

    def text(self, value: float | None) -> str:
        return "-" if value is None else f"{value:.{self.digits}f}"


def _count(title: str, name: str) -> Figure:
    """A count of the mesh: as near to the truth's as it was."""

    def band(stored: float, scores: dict) -> Band:
        true = scores["mesh"][name]["reference"]
        return true - abs(stored - true), true + abs(stored - true)

    return Figure(title, lambda scores: scores["mesh"][name]["found"], band)


def _rim(scores: dict) -> float | None:
    length = scores["mesh"]["boundary_length"]
    return length["found"] / length["reference"] if length["reference"] else None


def _near_one(stored: float, _: dict) -> Band:
    slack = abs(stored - 1) + 0.03
    return 1 - slack, 1 + slack


#: Two fits of one scene differ by about 0.005 % in chamfer distance and 0.3 dB; the slack is twice that, and
#: more where a fit is bad, as there it varies more.
FIGURES = {
    "boundary_loops": _count("loops", "boundary_loops"),
    "pinholes": _count("pin-holes", "pinholes"),
    "components": _count("components", "components"),
    "nonmanifold_edges": _count("non-manifold", "nonmanifold_edges"),
    "rim": Figure("rim", _rim, _near_one, 2),
    "chamfer": Figure(
        "chamfer %",
        lambda scores: scores["mesh"]["chamfer"],
        lambda stored, _: (None, stored + max(0.01, 0.1 * stored)),
        3,
    ),
    "f_score": Figure(
        "F-score",
        lambda scores: scores["mesh"]["f_score"],
        lambda stored, _: (stored - max(0.01, 0.1 * (1 - stored)), None),
        3,
    ),
    "novel_psnr": Figure(
        "novel dB", lambda scores: scores["mean"]["psnr"], lambda stored, _: (stored - 0.6, None), 2
    ),
    "mask_iou": Figure(
        "mask IoU",
        lambda scores: scores["mean"]["mask_iou"],
        lambda stored, _: (stored - max(0.001, 0.1 * (1 - stored)), None),
        4,
    ),
}


@dataclass(frozen=True)
class Expectation:
    """What a case came to when somebody last agreed to it.

    Attributes:
        fitted_by: the version of the code (``code_version``), or where the figures come from.
        figures: by name: the stored number and its band; empty if there is no stored result yet.
    """

    fitted_by: str | None
    figures: dict[str, tuple[float, Band]]

    @property
    def measured(self) -> bool:
        return bool(self.figures)

    @classmethod
    def of(cls, scores: dict, fitted_by: str) -> Expectation:
        """That later fits are no worse than these scores."""
        figures = {}
        for name, figure in FIGURES.items():
            value = figure.read(scores)
            if value is not None:
                value = round(value, figure.digits + 1) if figure.digits else value
                least, most = figure.band(value, scores)
                figures[name] = (value, (_rounded(least), _rounded(most)))
        return cls(fitted_by, figures)

    @classmethod
    def load(cls, path: Path) -> Expectation:
        """From a file that ``save`` wrote, or that somebody edited.

        Raises:
            UserError: it is missing or no such file.
        """
        try:
            document = read_json_object(path)
            figures = {
                name: (entry["stored"], (entry["least"], entry["most"]))
                for name, entry in document["figures"].items()
            }
            measured, fitted_by = document["measured"], document["fitted_by"]
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise UserError(
                f"'{path}' is missing or holds no stored result ({error!r}); write it again "
                f"with make regress ARGS=--update."
            ) from error
        if measured != bool(figures) or not set(figures) <= set(FIGURES):
            raise UserError(
                f"'{path}' holds figures that are unknown, or says wrongly that it is measured; "
                f"write it again with make regress ARGS=--update."
            )
        return cls(fitted_by, figures)

    def save(self, path: Path) -> None:
        """Writes it as JSON, a figure in a line."""
        lines = [
            f'  "{name}": {json.dumps({"stored": stored, "least": least, "most": most})}'
            for name, (stored, (least, most)) in self.figures.items()
        ]
        figures = "{\n" + ",\n".join(lines) + "\n }" if lines else "{}"
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            partial.write_text(
                f'{{\n "measured": {json.dumps(self.measured)},\n'
                f' "fitted_by": {json.dumps(self.fitted_by)},\n "figures": {figures}\n}}\n'
            )

    def stored(self, name: str) -> float | None:
        """The stored number of a figure."""
        return self.figures[name][0] if name in self.figures else None

    def left(self, scores: dict) -> dict[str, str]:
        """Of each figure that has left its band: by how much, in a sentence."""
        sentences = {}
        for name, (_, (least, most)) in self.figures.items():
            figure = FIGURES[name]
            value = figure.read(scores)
            if value is None:
                sentences[name] = f"{figure.title}: there is none"
            elif most is not None and value > most:
                sentences[name] = _sentence(figure, value, value - most, "above", most)
            elif least is not None and value < least:
                sentences[name] = _sentence(figure, value, least - value, "below", least)
        return sentences


def difference(before: Expectation, after: Expectation) -> list[str]:
    """A line for each figure whose stored number changes."""
    lines = []
    for name, figure in FIGURES.items():
        old, new = (figure.text(expectation.stored(name)) for expectation in (before, after))
        if old != new:
            lines.append(f"{figure.title}: {old} → {new}")
    return lines


def _sentence(figure: Figure, value: float, by: float, side: str, bound: float) -> str:
    return (
        f"{figure.title} is {figure.text(value)}, {by:.{figure.digits}f} {side} its band, which ends at "
        f"{figure.text(bound)}"
    )


def _rounded(bound: float | None) -> float | None:
    return None if bound is None else round(bound, 5)
