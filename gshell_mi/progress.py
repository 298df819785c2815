"""Progress on the terminal: one bar per stage with loss, PSNR, seconds per step and time left.

Without a terminal, as in a log file, a stage prints a line when it has begun, at its end, and every half a
minute.
"""

from __future__ import annotations

import time
import warnings
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager

from rich.progress import BarColumn, ProgressColumn, SpinnerColumn, Task, TextColumn
from rich.table import Column
from rich.text import Text

from .bars import Bars

#: Steps whose mean duration predicts the time left; old ones say little about a stage that gets slower.
_WINDOW = 20


class Progress:
    """Progress bars on stderr; if ``quiet`` nothing but warnings, which are Python's then.

    The time left is that of the running stage: the steps that remain times what the last few took.

    Attributes:
        warnings: all that was warned of.
    """

    def __init__(self, *, quiet: bool = False):
        self._quiet, self.warnings = quiet, list[str]()
        self._bars = Bars(
            SpinnerColumn(),
            TextColumn("{task.description}:", table_column=Column(min_width=19, no_wrap=True)),
            BarColumn(bar_width=24),
            _Detail(Column(no_wrap=True)),
            quiet=quiet,
        )
        self._console = self._bars.console

    def __enter__(self) -> Progress:
        self._bars.start()
        return self

    def __exit__(self, *_) -> None:
        self._bars.stop()

    def tell(self, message: str) -> None:
        """One line above the bars."""
        self._console.print(message)

    def warn(self, message: str) -> None:
        """The same for what may be wrong."""
        self.warnings.append(message)
        if self._quiet:
            warnings.warn(message, stacklevel=2)
        else:
            self._console.print(f"[yellow]warning:[/] {message}")

    @contextmanager
    def stage(self, name: str, total: int | None, done: int = 0) -> Iterator[Callable]:
        """A bar for a stage of ``total`` steps; yields the function to call after each of them."""
        task = self._bars.add_task(name, total=total, completed=done, detail="")
        durations: deque[float] = deque(maxlen=_WINDOW)
        begin = last = time.monotonic()

        def advance(values: Mapping[str, float] | None = None) -> None:
            nonlocal last, done
            now = time.monotonic()
            durations.append(now - last)
            last = now
            done += 1
            detail = f"{done}/{total}"
            if total is not None and len(durations) > 1:
                step = usual_duration(durations)
                detail += f"  {step:.2f} s/step  {_clock((total - done) * step)} left"
            if values and "loss" in values:
                quality = f"  PSNR {values['psnr']:.1f} dB" if "psnr" in values else ""
                detail = f"loss {values['loss']:.4f}{quality}  {detail}"
            self._bars.update(task, completed=done, detail=detail)

        try:
            yield advance
        except BaseException:
            self._bars.remove_task(task)  # what remains on the terminal is what was done
            raise
        took = f"{time.monotonic() - begin:.1f} s"
        self._bars.update(task, total=total or 1, completed=total or 1, detail=took)
        if self._bars.in_lines:
            self._console.print(f"{name}: took {took}", soft_wrap=True)

    def reference(self, done: int, total: int) -> None:
        """In the running stage targets are rendered from a reference scene: ``done`` of ``total``."""
        if task := self._bars.running:
            self._bars.update(task.id, completed=done, total=total, detail=f"{done}/{total} rendered")


class _Detail(ProgressColumn):
    """How far a stage is; before it has said so, for how long it has been at it."""

    def render(self, task: Task) -> Text:
        return Text(task.fields["detail"] or f"{_clock(task.elapsed or 0)} so far")


def usual_duration(durations: Collection[float]) -> float:
    """The mean of two or more durations without the longest, which may have compiled kernels: what a machine
    does only once must not count for every step that remains.

    >>> usual_duration([9.0, 0.5, 0.25])
    0.375
    """
    return (sum(durations) - max(durations)) / (len(durations) - 1)


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes}:{seconds:02d}"
