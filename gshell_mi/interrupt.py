"""Ctrl-C that is never lost."""

from __future__ import annotations

import ctypes
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from .streams import leave


class Interrupt:
    """Context in which ``check`` raises a ``KeyboardInterrupt`` again that got lost.

    Python raises it wherever it happens to be. If that is in a function which C++ has called, the exception
    may end there or become another one, and the program goes on as if nothing had been. Within another such
    context this one shares what that knows.
    """

    def __init__(self):
        self._pending = False
        self._previous = None
        self._outer = None

    def __enter__(self) -> Interrupt:
        # Handlers of the application around us, and threads that may not set any, are left alone.
        if threading.current_thread() is threading.main_thread():
            handler = signal.getsignal(signal.SIGINT)
            if handler in (signal.default_int_handler, leave):
                self._previous = signal.signal(signal.SIGINT, self._handle)
            elif isinstance(outer := getattr(handler, "__self__", None), Interrupt):
                self._outer = outer
        return self

    def __exit__(self, *_: object) -> None:
        if self._previous is not None:
            signal.signal(signal.SIGINT, self._previous)

    @property
    def pending(self) -> bool:
        """Whether there was a Ctrl-C."""
        return self._outer.pending if self._outer else self._pending

    def check(self) -> None:
        """To be called from time to time."""
        if self.pending:
            raise KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self._pending = True
        signal.default_int_handler(number, frame)


@contextmanager
def interrupts_held_back() -> Iterator[None]:
    """Context whose work Ctrl-C does not cut in two: the ``KeyboardInterrupt`` comes at its end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came = []
    previous = signal.signal(signal.SIGINT, lambda *given: came.append(given))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
    if came and callable(previous):
        previous(*came[0])


def forget_interrupt() -> None:
    """Lets the process end with its own exit code after a Ctrl-C that was handled.

    Where C++ was running Python code then, as Mitsuba does while a variant loads, CPython keeps in mind that
    nobody has handled it there, and dies of the signal at its end. It forgets when it runs other code so.
    """
    ctypes.pythonapi.PyRun_SimpleString(b"pass")


def check_interrupt() -> None:
    """``Interrupt.check`` of the context around, if there is one."""
    if threading.current_thread() is threading.main_thread():
        context = getattr(signal.getsignal(signal.SIGINT), "__self__", None)
        if isinstance(context, Interrupt):
            context.check()
