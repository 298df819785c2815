"""Ctrl-C that is never lost."""

from __future__ import annotations

import signal
import threading


class Interrupt:
    """Context in which ``check`` raises a ``KeyboardInterrupt`` again that got lost.

    Python raises it wherever it happens to be. If that is in a function which C++ has called, the exception
    may end there, and the program goes on as if nothing had been.
    """

    def __init__(self):
        self._pending = False
        self._previous = None

    def __enter__(self) -> Interrupt:
        # Handlers of the application around us, and threads that may not set any, are left alone.
        if (threading.current_thread() is threading.main_thread()
                and signal.getsignal(signal.SIGINT) is signal.default_int_handler):
            self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_) -> None:
        if self._previous is not None:
            signal.signal(signal.SIGINT, self._previous)

    def check(self) -> None:
        """To be called from time to time."""
        if self._pending:
            raise KeyboardInterrupt

    def _handle(self, number: int, frame) -> None:
        self._pending = True
        signal.default_int_handler(number, frame)
