"""Bars on the terminal; without a terminal, as in a log, lines of what is being done."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task

Value = TypeVar("Value")

#: Seconds between two lines of one task where there is no terminal.
PAUSE = 30.0

#: Seconds after which a task that is not done yet has its first line.
_BEGUN = 1.0


class Bars(Progress):
    """As ``rich.progress.Progress``, on stderr.

    Without a terminal the newest task that is not done has a line soon after it has begun, and one every half
    a minute, whether it gets on or not.

    Args:
        columns: default: what, the bar, per cent and the time left.
        quiet: shows nothing.
        transient: bars go when they are done.
        pause, begun: seconds between two lines, and up to the first one.
    """

    def __init__(
        self,
        *columns: str | ProgressColumn,
        quiet: bool = False,
        transient: bool = False,
        pause: float = PAUSE,
        begun: float = _BEGUN,
    ):
        console = Console(stderr=True, quiet=quiet, highlight=False)
        super().__init__(
            *columns, console=console, transient=transient, disable=quiet or not console.is_terminal
        )
        self.in_lines = not quiet and not console.is_terminal
        self._pause, self._begun = pause, begun
        self._ended, self._teller = threading.Event(), None

    def start(self) -> None:
        """Begins to show the tasks."""
        super().start()
        if self.in_lines and self._teller is None:
            self._ended.clear()
            self._teller = threading.Thread(target=self._tell, daemon=True)
            self._teller.start()

    def stop(self) -> None:
        """Ends that."""
        super().stop()
        if self._teller is not None:
            self._ended.set()
            self._teller.join()
            self._teller = None

    def each(self, values: Iterable[Value], total: int) -> Iterator[Value]:
        """The values, of which there are so many, as a task; ``track`` of rich tells nothing in lines."""
        task = self.add_task("", total=total)
        for value in values:
            yield value
            self.advance(task)

    @property
    def running(self) -> Task | None:
        """The newest task that is not done; None if all are."""
        return next((task for task in reversed(self.tasks) if not task.finished), None)

    def _tell(self) -> None:
        told, due = None, 0.0
        while not self._ended.wait(self._begun):
            task, now = self.running, time.monotonic()
            if task is None or (task.id == told and now < due):
                continue
            told, due = task.id, now + self._pause
            texts = (
                str(column if isinstance(column, str) else column.render(task))
                for column in self.columns
                if not isinstance(column, BarColumn | SpinnerColumn)
            )
            self.console.print(" ".join(text for text in texts if text), soft_wrap=True)
