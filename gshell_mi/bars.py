"""Bars on the terminal for what is one task; without a terminal, as in a log, a line every half a minute."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TaskID

Value = TypeVar("Value")

#: Seconds between two lines where there is no terminal.
PAUSE = 30.0


class Bars(Progress):
    """As ``rich.progress.Progress``, on stderr.

    Args:
        columns: default: what, the bar, per cent and the time left.
        quiet: shows nothing.
        transient: bars go when they are done.
    """

    def __init__(self, *columns: str | ProgressColumn, quiet: bool = False, transient: bool = False):
        console = Console(stderr=True, highlight=False)
        super().__init__(
            *columns, console=console, transient=transient, disable=quiet or not console.is_terminal
        )
        self._in_lines, self._told = not quiet and not console.is_terminal, -math.inf

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Changes a task."""
        super().update(task_id, **changes)
        self._tell(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Takes a task so many steps on."""
        super().advance(task_id, advance)
        self._tell(task_id)

    def each(self, values: Iterable[Value], total: int) -> Iterator[Value]:
        """The values, of which there are so many, as a task; ``track`` of rich tells nothing in lines."""
        task = self.add_task("", total=total)
        for value in values:
            yield value
            self.advance(task)

    def _tell(self, task_id: TaskID) -> None:
        now = time.monotonic()
        if not self._in_lines or now - self._told < PAUSE:
            return
        self._told = now
        task = next(task for task in self.tasks if task.id == task_id)
        texts = (
            str(column if isinstance(column, str) else column.render(task))
            for column in self.columns
            if not isinstance(column, BarColumn)
        )
        self.console.print(" ".join(text for text in texts if text), soft_wrap=True)
