"""Shows the doctests of docstrings as code, for the pages that ``make docs`` builds."""

from __future__ import annotations

import re
from typing import Any

import griffe


def fenced(text: str) -> str:
    """The text with every doctest in a fence of its own.

    >>> print(fenced("Doubles.\\n\\n>>> twice(2)\\n4"))
    Doubles.
    <BLANKLINE>
    ```pycon
    >>> twice(2)
    4
    ```
    """
    lines: list[str] = []
    indent: str | None = None
    for line in [*text.split("\n"), ""]:
        if indent is None and (begin := re.match(r"( *)>>> ", line)):
            indent = begin[1]
            lines.append(f"{indent}```pycon")
        elif indent is not None and not line.strip():
            lines.append(f"{indent}```")
            indent = None
        lines.append(line)
    return "\n".join(lines[:-1])


class Doctests(griffe.Extension):
    """Fences the doctests of every object."""

    def on_object(self, *, obj: griffe.Object, **others: Any) -> None:
        if obj.docstring:
            obj.docstring.value = fenced(obj.docstring.value)
