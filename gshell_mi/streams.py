"""What a process needs from its first moment on: streams that can be written, and Ctrl-C.

Imports nothing that takes long, as it comes before all else.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
from collections.abc import Callable, Iterable
from typing import Any, TextIO

from .errors import UserError


def begin_command() -> None:
    """To be called first of all: if this process is one of our commands, Ctrl-C ends it at once and quietly.

    Nothing has been done yet, and Python's own exception may be lost or garbled while modules are imported.
    Descriptors 0 to 2 that are closed are opened, or the next file would take their place and be written by
    whoever prints.
    """
    if not _runs_command():
        return
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, leave)


def _runs_command() -> bool:
    """Whether this process was started as ``python -m gshell_mi.NAME`` or as the console script
    ``gshell-NAME``."""
    started = "".join(sys.argv[:1])
    # As long as python -m looks for the module that is run, argv says just that.
    if started == "-m":
        module = sys.orig_argv[sys.orig_argv.index("-m") + 1] if "-m" in sys.orig_argv[:-1] else ""
        return module.startswith("gshell_mi.")
    return re.fullmatch(r"gshell-[a-z]+(\.exe)?", os.path.basename(started)) is not None


def leave(*_: object) -> None:
    """A handler of signals: says that it was interrupted, and ends the process."""
    with contextlib.suppress(OSError):
        os.write(2, b"Interrupted.\n")
    os._exit(130)


class Forgiving:
    """A text stream that what it writes to may leave: from then on it writes nowhere.

    Attributes:
        error: what happened then; None as long as all is well.
    """

    def __init__(self, stream: TextIO | None):
        self._stream, self.error = stream, None

    def write(self, text: str) -> int:
        self._try(lambda stream: stream.write(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        self._try(lambda stream: stream.flush())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _try(self, action: Callable[[TextIO], object]) -> None:
        if self._stream is None or self.error is not None:
            return
        try:
            action(self._stream)
        except (OSError, ValueError) as error:  # ValueError: it was closed
            self.error = error
            # What is left in its buffer, and what compiled code prints, has to go somewhere.
            with contextlib.suppress(OSError, ValueError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)


def with_streams(run: Callable[[], int]) -> int:
    """Runs a command, whose exit code ``run`` returns, whatever becomes of its output meanwhile.

    A reader that has left (``| head -1``) needs no more words: the command goes on. Output that cannot be
    written for another reason is a mistake that is told on stderr. So are a ``UserError``, and an ``OSError``
    that nobody has put better.
    """
    out, err = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = Forgiving(out), Forgiving(err)
    try:
        try:
            code = run()
        except UserError as error:
            code = _tell(str(error))
        except OSError as error:
            where = "A file" if error.filename is None else f"'{error.filename}'"
            code = _tell(
                f"{where} cannot be read or written ({error.strerror or error}); check the path, "
                f"its permissions and the free space."
            )
        sys.stdout.flush()
        failed = sys.stdout.error
        if code == 0 and failed is not None and not isinstance(failed, BrokenPipeError):
            code = _tell(
                f"What was found cannot be printed ({getattr(failed, 'strerror', None) or failed}), "
                f"though all files are written; print it to another place."
            )
        return code
    finally:
        # What fails now would fail when Python ends, and then not quietly.
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = out, err


def _tell(sentence: str) -> int:
    print(f"error: {sentence}", file=sys.stderr)
    return 2
