"""Runs a case of the regression net: fit, score, compare with what is stored, note it in the table."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from cases import Case
from fit_study.expectations import FIGURES, Expectation, difference
from fit_study.trials import Outcome, code_version, run_trial


@dataclass
class Net:
    """One run over cases.

    Attributes:
        output: folder of the fits, of what is made for them, and of ``table.md``.
        update: store what is found instead of comparing it.
        fresh: make every fit anew, also those that this version of the code has made.
    """

    output: Path
    update: bool = False
    fresh: bool = False
    _rows: int = field(default=0, init=False)

    @property
    def table(self) -> Path:
        return self.output / "table.md"

    def run(self, case: Case) -> None:
        """Fits and compares; fails the test with a line for each figure that has left its band."""
        before = Expectation.load(case.expected)
        if not before.measured and not self.update:
            pytest.skip("no stored result yet: run make regress ARGS=--update")
        outcome = self._outcome(case)
        if outcome.error:
            self._note(case, outcome, before, f"**failed**: {outcome.error}")
            pytest.fail(f"{case.name} has no surface to score: {outcome.error}", pytrace=False)
        if self.update:
            self._store(case, outcome, before)
            return
        left = before.left(outcome.scores)
        verdict = f"**left its band: {', '.join(FIGURES[name].title for name in left)}**" if left else "held"
        self._note(case, outcome, before, verdict, left)
        if left:
            pytest.fail(
                "\n".join(
                    [
                        f"{case.name} is worse than what is stored:",
                        *left.values(),
                        f"The fits so far are in {self.table}.",
                    ]
                ),
                pytrace=False,
            )

    def _outcome(self, case: Case) -> Outcome:
        trial = case.prepare(self.output)
        # A folder per version of the code: neither fits nor interrupted halves of another one count.
        fits = self.output / code_version()
        if self.fresh:
            trial.record(fits).unlink(missing_ok=True)
            shutil.rmtree(fits / trial.scene.stem / trial.name, ignore_errors=True)
        return run_trial(trial, fits)

    def _store(self, case: Case, outcome: Outcome, before: Expectation) -> None:
        after = Expectation.of(outcome.scores, outcome.code)
        after.save(case.expected)
        changes = difference(before, after)
        print(f"\n{case.name}: {'; '.join(changes) or 'nothing changes'}")
        self._note(case, outcome, before, "stored" if changes else "stored, unchanged")

    def _note(
        self,
        case: Case,
        outcome: Outcome,
        before: Expectation,
        verdict: str,
        left: dict[str, str] | None = None,
    ) -> None:
        """Adds a line to the table, and the heading before the first of a run."""
        self.output.mkdir(parents=True, exist_ok=True)
        lines = []
        if not self._rows:
            titles = [figure.title for figure in FIGURES.values()]
            lines += [
                "",
                f"## {time.strftime('%Y-%m-%d %H:%M')}, code {code_version()}",
                "",
                f"| case | {' | '.join(titles)} | CPU s | |",
                "|---" * (len(titles) + 3) + "|",
            ]
        self._rows += 1
        cells = [_cell(name, outcome, before, name in (left or ())) for name in FIGURES]
        seconds = "-" if outcome.cpu_seconds is None else f"{outcome.cpu_seconds:.0f}"
        lines.append(f"| {case.name} | {' | '.join(cells)} | {seconds} | {verdict} |")
        with self.table.open("a") as file:
            file.write("\n".join(lines) + "\n")


def _cell(name: str, outcome: Outcome, before: Expectation, left: bool) -> str:
    figure = FIGURES[name]
    old, new = figure.text(before.stored(name)), "-"
    if outcome.scores:
        new = figure.text(figure.read(outcome.scores))
    text = new if old == new else f"{old} → {new}"
    return f"**{text}**" if left else text
