"""Which files a Mitsuba scene reads, found in its XML without loading it."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from .scene_files import substituted

#: Folders in which files are looked for, at most.
_ROOTS = 16


def scene_inputs(path: Path) -> set[Path]:
    """The XML file, those that it includes, and all files that any of its values names.

    A value is taken for a file's name if there is such a file, beside the XML that holds it, beside ``path``
    or in a folder that a ``<path>`` names; what cannot be read as XML names none.
    """
    found: set[Path] = set()
    _gather(Path(path), [Path(path).parent], {}, found)
    return found


def _gather(path: Path, roots: list[Path], parameters: dict[str, str], found: set[Path]) -> None:
    found.add(path)
    try:
        document = ElementTree.parse(path).getroot()
    except (OSError, ValueError, RecursionError, ElementTree.ParseError):
        return
    parameters = parameters | {
        node.get("name", ""): node.get("value", "") for node in document.iter("default")
    }

    folders = [substituted(node.get("value", ""), parameters) for node in document.iter("path")]
    roots = (roots + [roots[0] / folder for folder in folders])[:_ROOTS]
    for node in document.iter():
        for value in node.attrib.values():
            for file in {folder / substituted(value, parameters) for folder in (path.parent, *roots)}:
                if _is_file(file) and file not in found:
                    found.add(file)
                    if node.tag == "include":
                        _gather(file, roots, parameters, found)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, or with a NUL
        return False
