"""Which photographs are compared with which."""

from __future__ import annotations

from collections.abc import Sequence

#: Every frame of a video is compared with so many after it ...
_OVERLAP = 10
#: ... and one in so many with all others of these, which closes loops.
_LOOP = 5


def pairs_of(names: Sequence[str], *, sequential: bool) -> list[tuple[str, str]]:
    """All pairs of names; if ``sequential``, those of near neighbours and those of every fifth.

    >>> len(pairs_of([str(i) for i in range(30)], sequential=False))
    435
    >>> len(pairs_of([str(i) for i in range(30)], sequential=True))
    251
    """
    count = len(names)
    return [
        (names[i], names[j])
        for i in range(count)
        for j in range(i + 1, count)
        if not sequential or j - i <= _OVERLAP or i % _LOOP == j % _LOOP == 0
    ]
