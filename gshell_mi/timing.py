"""Where the time of an iteration goes: phases that cost nothing unless somebody holds a stopwatch."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import drjit as dr

#: The stopwatch that runs; at most one does.
_running: Stopwatch | None = None


class Stopwatch:
    """Seconds per phase while it runs (``with stopwatch:``).

    Dr.Jit computes lazily, in kernels that may span phases. A running stopwatch therefore makes every phase
    compute what it is given, and waits for it: an iteration takes a little longer than without.

    Args:
        clock: seconds, ``time.perf_counter`` (wall time) or ``time.process_time`` (of all threads).

    >>> with Stopwatch() as watch:
    ...     for _ in range(3):
    ...         with phase("sleep"):
    ...             time.sleep(0.01)
    >>> watch.seconds["sleep"] > 0.03
    True
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter):
        self.clock = clock
        self.seconds: dict[str, float] = defaultdict(float)

    def __enter__(self) -> Stopwatch:
        global _running
        _running = self
        return self

    def __exit__(self, *_: object) -> None:
        global _running
        _running = None


@contextmanager
def phase(name: str) -> Iterator[Callable]:
    """Attributes the time of the block to a phase; phases inside are taken out of the ones around them.

    Yields a function that takes the Dr.Jit variables which the phase has to have computed at its end.
    """
    watch = _running
    if watch is None:
        yield _ignore
        return
    results: list[object] = []
    dr.eval()
    dr.sync_thread()
    begin, before = watch.clock(), sum(watch.seconds.values())
    yield lambda *values: results.extend(values)
    dr.eval(results)
    dr.sync_thread()
    inner = sum(watch.seconds.values()) - before
    watch.seconds[name] += watch.clock() - begin - inner


def _ignore(*_: object) -> None:
    pass
