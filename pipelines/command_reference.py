"""Writes docs/commands.md from the dataclasses that are the commands' arguments.

python pipelines/command_reference.py           # writes it
python pipelines/command_reference.py --check   # exit code 1 if it is out of date
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import itertools
import re
import sys
import textwrap
import typing
from pathlib import Path

COMMANDS = (
    "capture",
    "fit",
    "export",
    "turntable",
    "compare",
    "report",
    "dataset",
    "train",
    "generate",
    "generate.evaluate",
    "batch",
)
PAGE = Path(__file__).parents[1] / "docs" / "commands.md"

_INTRODUCTION = """\
# Commands

Made from the code by `python pipelines/command_reference.py`; each command's `--help` says the same. All
leave with exit code 0 on success and 2 on a mistake in what they were given: one sentence on stderr tells
which, and how to mend it. `python -m gshell_mi.doctor` tells whether this machine can run them. All but
`generate.evaluate` are installed under a shorter name too: `gshell-fit` is `python -m gshell_mi.fit`.
"""


def reference() -> str:
    """The whole page."""
    sections = [_INTRODUCTION]
    for command in COMMANDS:
        inner = command if "." in command else f"{command}.__main__"
        module = importlib.import_module(f"gshell_mi.{inner}")
        title = module.__doc__.splitlines()[0].split(": ", 1)[1]
        sections.append(
            f"## `python -m gshell_mi.{command}`\n\n{title[0].upper()}{title[1:]}\n\n"
            + "\n\n".join(_tables(module._Arguments))
            + "\n"
        )
    return "\n".join(sections)


def _tables(arguments: type, prefix: str = "") -> list[str]:
    """The arguments of a dataclass as a table, and after it those of the dataclasses nested in it."""
    rows, nested = ["| argument | default | |", "|---|---|---|"], []
    types = typing.get_type_hints(arguments, include_extras=True)
    texts = field_texts(arguments)
    for field in dataclasses.fields(arguments):
        kind = types[field.name]
        inner = typing.get_args(kind)[0] if typing.get_origin(kind) is typing.Annotated else kind
        if dataclasses.is_dataclass(inner) and field.name == "config":
            own, *rest = _tables(inner)
            rows += own.splitlines()[2:]
            nested += rest
        elif dataclasses.is_dataclass(inner):
            table, *_ = _tables(inner, f"{field.name}.")
            nested += [f"### `--{field.name}`\n\n{inner.__doc__.splitlines()[0]}", table]
        else:
            rows.append(_row(field, str(getattr(kind, "__metadata__", "")), prefix, texts[field.name]))
    return ["\n".join(rows), *nested]


def _row(field: dataclasses.Field, metadata: str, prefix: str, text: str) -> str:
    renamed = re.search(r"\bname='(\w+)'", metadata)
    name = "--" + f"{prefix}{renamed[1] if renamed else field.name}".replace("_", "-")
    if short := re.search(r"'(-\w)'", metadata):
        name = f"{short[1]}, {name}"
    if "positional" in metadata.lower():
        name = field.name.upper()
    if field.default is True:
        stage, dot, last = name.removeprefix("--").rpartition(".")
        return f"| `--{stage}{dot}no-{last}` | off | Switches off: {text[:1].lower()}{text[1:]} |"
    return f"| `{name}` | {_default(field)} | {text} |"


def _default(field: dataclasses.Field) -> str:
    if field.default in (dataclasses.MISSING, None):
        return ""
    if field.default is False:
        return "off"
    return f"`{field.default}`"


def field_texts(arguments: type) -> dict[str, str]:
    """The docstring under each field; that of a base class where a class only gives another default."""
    texts = {}
    for kind in reversed([kind for kind in arguments.__mro__ if dataclasses.is_dataclass(kind)]):
        body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0].body
        for statement, following in itertools.pairwise(body):
            if (
                isinstance(statement, ast.AnnAssign)
                and isinstance(following, ast.Expr)
                and isinstance(following.value, ast.Constant)
            ):
                texts[statement.target.id] = " ".join(following.value.value.split()).replace("|", "\\|")
    return texts


def main() -> int:
    if "--check" in sys.argv[1:]:
        return int(PAGE.read_text() != reference())
    PAGE.write_text(reference())
    return 0


if __name__ == "__main__":
    sys.exit(main())
