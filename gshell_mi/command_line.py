"""What all commands of the package have in common: arguments in, an exit code out."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import tyro

from .doctor import ensure_variant
from .interrupt import Interrupt
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
        parsed = parse() if default is None else parse(default=default)
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
        print(interrupted(parsed), file=sys.stderr)
        return 130

    return with_streams(run)
