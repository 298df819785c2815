"""Which files a Mitsuba scene reads, found in its XML without loading it."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

_PARAMETER = re.compile(r"\$(\w+)")


def scene_files(path: Path) -> set[Path]:
    """The XML file, those that it includes, and all files that any of its values names.

    A value is taken for a file's name if there is such a file, beside the XML that holds it or beside
    ``path``; what cannot be read as XML names none.
    """
    found: set[Path] = set()
    _gather(Path(path), Path(path).parent, {}, found)
    return found


def _gather(path: Path, root: Path, parameters: dict[str, str], found: set[Path]) -> None:
    found.add(path)
    try:
        document = ElementTree.parse(path).getroot()
    except (OSError, ValueError, RecursionError, ElementTree.ParseError):
        return
    parameters = parameters | {node.get("name", ""): node.get("value", "")
                               for node in document.iter("default")}
    for node in document.iter():
        for value in node.attrib.values():
            name = _PARAMETER.sub(lambda match: parameters.get(match[1], match[0]), value)
            for file in {path.parent / name, root / name}:
                if _is_file(file) and file not in found:
                    found.add(file)
                    if node.tag == "include":
                        _gather(file, root, parameters, found)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, or with a NUL
        return False
