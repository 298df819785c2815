"""Work in a process of its own, so that torch's threads and Dr.Jit's never meet."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from ..doctor import ensure_variant
from ..errors import UserError
from ..lifetime import end_with_parent


def in_own_process(work: Callable, *arguments: Any, variant: str | None = None) -> Any:
    """What ``work(*arguments)`` returns or raises, computed in a fresh process.

    Args:
        work: a function of a module; arguments and result are pickled.
        variant: Mitsuba variant to set there; None for none.

    Raises:
        UserError: also where the process was killed, as for want of memory.
    """
    context = multiprocessing.get_context("spawn")
    with told_if_killed(), ProcessPoolExecutor(1, context, initializer=_begin, initargs=(variant,)) as pool:
        return pool.submit(work, *arguments).result()


@contextmanager
def told_if_killed() -> Iterator[None]:
    """Raises ``UserError`` where a process of a pool was ended from outside."""
    try:
        yield
    except BrokenProcessPool as error:
        raise UserError(
            "A process that computes was ended from outside, perhaps for want of memory; free some, or ask "
            "for less at once."
        ) from error


def _begin(variant: str | None) -> None:
    end_with_parent()
    if variant is not None:
        ensure_variant(variant)


def require_torch() -> None:
    """Raises ``UserError`` where the extra is not installed."""
    from importlib.util import find_spec

    missing = [name for name in ("torch", "monai", "einops", "safetensors") if find_spec(name) is None]
    if missing:
        raise UserError(
            f"This needs {' and '.join(missing)}; install them with pip install 'gshell_mi[generate]'."
        )
