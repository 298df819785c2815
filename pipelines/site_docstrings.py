"""Docstrings as the pages of ``make docs`` show them: an extension of Griffe, which reads the sources."""

from __future__ import annotations

import re
import textwrap
from typing import Any

import griffe


def shown(text: str) -> str:
    """A docstring with its doctests as code, and what is returned as a paragraph: it is told in prose here,
    whose first colon does not end a type."""
    text = re.sub(
        r"^Returns:\n((?:    .*(?:\n|$))+)",
        lambda found: f"**Returns:** {textwrap.dedent(found[1])}",
        text,
        flags=re.M,
    )
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


def comment_at(lines: list[str], number: int) -> str:
    """The comment ``#: ...`` of a value: behind it, in the line with that number (from 1), or above it.

    >>> comment_at(["#: How many,", "#: at most.", "COUNT = 3", "size: int  #: in pixels"], 3)
    'How many,\\nat most.'
    >>> comment_at(["size: int  #: in pixels"], 1)
    'in pixels'
    """
    if behind := re.search(r"#: (.*)", lines[number - 1]):
        return behind[1]
    above = []
    for line in reversed(lines[: number - 1]):
        if not (comment := re.fullmatch(r"\s*#: ?(.*)", line)):
            break
        above.append(comment[1])
    return "\n".join(reversed(above))


class Docstrings(griffe.Extension):
    """Shows docstrings, and the comments that stand for them at values."""

    def on_object(self, *, obj: griffe.Object, **others: Any) -> None:
        if obj.docstring:
            obj.docstring.value = shown(obj.docstring.value)
        elif isinstance(obj, griffe.Attribute) and obj.lineno:
            if comment := comment_at(obj.lines_collection[obj.filepath], obj.lineno):
                obj.docstring = griffe.Docstring(comment, parent=obj)
