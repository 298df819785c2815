"""``python -m gshell_mi.fit`` on one thread, where sums have one order: equal fits are equal bit by bit."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import Any

import drjit as dr
import mitsuba as mi

from gshell_mi import command_line
from gshell_mi.fit.__main__ import main


def _one_thread(variant: str) -> None:
    mi.set_variant(variant)
    dr.set_thread_count(1)


def _on_two(work: Callable[..., Any]) -> Callable[..., Any]:
    """The same with a second thread for a while: Mitsuba waits for it to read and write OpenEXR files."""

    @wraps(work)
    def done(*arguments: Any, **options: Any) -> Any:
        dr.set_thread_count(2)
        try:
            return work(*arguments, **options)
        finally:
            dr.set_thread_count(1)

    return done


if __name__ == "__main__":
    command_line.ensure_variant = _one_thread
    mi.Bitmap.write = _on_two(mi.Bitmap.write)
    mi.parser.instantiate = _on_two(mi.parser.instantiate)
    sys.exit(main())
