"""What all commands of the package have in common: arguments in, an exit code out."""

from __future__ import annotations

import io
import itertools
import os
import re
import sys
from collections.abc import Callable
from contextlib import redirect_stderr
from difflib import get_close_matches
from functools import partial
from typing import TypeVar

import tyro

from .doctor import ensure_variant
from .errors import UserError
from .interrupt import Interrupt, forget_interrupt
from .kernel_cache import kernel_cache_problem
from .streams import with_streams

Arguments = TypeVar("Arguments")


def run_command(
    name: str,
    description: str,
    arguments: type[Arguments],
    work: Callable[[Arguments], None],
    given: list[str] | None,
    *,
    default: Arguments | None = None,
    check: Callable[[list[str]], None] = lambda words: None,
    interrupted: Callable[[Arguments], str] = lambda _: "Interrupted.",
) -> int:
    """Parses the arguments, sets their Mitsuba variant, if they have one, and does the work.

    Args:
        name: the package that is the command, as in ``python -m gshell_mi.NAME``.
        description: one sentence for ``--help``.
        arguments: a dataclass; without a field ``variant`` no variant is set.
        work: what the command does; only now may it import modules that need a variant.
        given: the arguments; None: those of the process.
        default: values of the fields that are not given, in place of the dataclass's own;
            ``tyro.MISSING`` where there is none.
        check: is called with the words before they are parsed, and may raise a ``UserError``.
        interrupted: what to say after Ctrl-C.

    Returns:
        The exit code: 0, 2 after a user's mistake (told on stderr in one sentence), 130 after Ctrl-C.
    """

    def run() -> int:
        check(sys.argv[1:] if given is None else given)
        parse = partial(
            tyro.cli,
            arguments,
            args=given,
            prog=f"python -m gshell_mi.{name}",
            description=description,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
        parsed = _parsed(parse if default is None else partial(parse, default=default), name)
        with Interrupt() as interrupt:
            try:
                if (variant := getattr(parsed, "variant", None)) is not None:
                    ensure_variant(variant)
                    if problem := kernel_cache_problem():
                        print(f"warning: {problem}", file=sys.stderr)
                interrupt.check()
                work(parsed)
            except KeyboardInterrupt:
                pass
            except Exception:
                # Raised while C++ was calling Python, Ctrl-C comes out of it as an error of any kind.
                if not interrupt.pending:
                    raise
            else:
                return 0
        forget_interrupt()
        print(interrupted(parsed), file=sys.stderr)
        return 130

    return with_streams(run)


def _parsed(parse: Callable[[], Arguments], name: str) -> Arguments:
    """What a parser of tyro reads.

    Raises:
        UserError: words that it does not understand; it would fill a box with them.
    """
    try:
        with redirect_stderr(io.StringIO()):
            return parse()
    except SystemExit as stop:
        if stop.code != 2:
            raise
    columns, os.environ["COLUMNS"] = os.environ.get("COLUMNS"), "10000"
    try:  # once more, without wrapped lines
        with redirect_stderr(told := io.StringIO()):
            return parse()
    except SystemExit:
        raise UserError(_sentence_of(told.getvalue(), name)) from None
    finally:
        del os.environ["COLUMNS"]
        if columns is not None:
            os.environ["COLUMNS"] = columns


def _sentence_of(box: str, name: str) -> str:
    """What is wrong and how to mend it, of a box that tyro prints."""
    lines = [re.sub(r"[\u2500-\u257f]", "", line).strip() for line in box.splitlines()[1:-1]]
    wrong = " ".join(itertools.takewhile(bool, lines)).rstrip(".")
    helped = f"python -m gshell_mi.{name} --help lists all options"
    unknown = re.match(r"Unrecognized options: ([^,]+)", wrong)
    if not unknown:
        return f"{wrong}; {helped}."
    known = [line.split()[0] for line in lines if line.startswith("--")]
    near = get_close_matches(unknown[1], known, 1)
    return f"{unknown[1]} is no option; " + (f"did you mean {near[0]}? " if near else "") + f"{helped}."
