"""Processes that end with the one that started them."""

from __future__ import annotations

import contextlib
import ctypes
import signal

_PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>


def end_with_parent() -> None:
    """To be called in a new process: it ends when the thread that started it does, however that ends (Linux).

    Or a killed command would leave others behind that go on computing, and write into its folders.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
