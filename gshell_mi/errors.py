"""The one exception for mistakes that a user can mend, and what others' exceptions say."""


class UserError(Exception):
    """A mistake in the input, told in one sentence: which file, what is wrong, what to do.

    The commands print it on stderr and leave with exit code 2; library users catch it like any
    exception. Programming errors are not of this type and keep their traceback.
    """


def first_line(error: Exception) -> str:
    """First line of an exception's message, or its type's name if it has none."""
    return _lines(error)[0]


def last_line(error: Exception) -> str:
    """Last line of it: some libraries put a traceback first."""
    return _lines(error)[-1]


def _lines(error: Exception) -> list[str]:
    return str(error).strip().splitlines() or [type(error).__name__]
