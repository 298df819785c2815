"""Which file a capture means: names without suffix, in another case, or from another machine."""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path, PurePosixPath

from .decoding import SUFFIXES


def existing(named: Path) -> Path | None:
    """The file of that name, or the one that differs in the suffix only: left out, or in another case.

    Names are equal if they are so to a reader: some systems keep accents apart from their letters.
    """
    try:
        if named.is_file():
            return named
        # Blender's sets leave the suffix out; a name's own dots are no suffix.
        completed = (named.with_name(named.name + suffix) for suffix in SUFFIXES) if named.name else ()
        found = next((file for file in completed if file.is_file()), None)
        if found is not None or not named.name or (folder := _existing_folder(named.parent)) is None:
            return found
        there = _by_spelling(str(folder), folder.stat().st_mtime_ns)
    except (OSError, ValueError):  # names that cannot be a file's
        return None
    keys = [_spelling(named.name), *(_spelling(named.name + suffix) for suffix in SUFFIXES)]
    return next((folder / there[key] for key in keys if key in there), None)


def entry_of(folder: Path, name: str) -> Path:
    """The file or folder of that name, such as ``sparse/0``, or the one that differs in case only: a capture
    may have been on a system that does not tell ``IMAGES.TXT`` from ``images.txt``. Where there is none, the
    path that it would have."""
    for part in PurePosixPath(name).parts:
        path = folder / part
        if not path.exists() and folder.is_dir():
            path = folder / _by_case(str(folder), folder.stat().st_mtime_ns).get(part.casefold(), part)
        folder = path
    return folder


def _existing_folder(named: Path) -> Path | None:
    if named.is_dir():
        return named
    parent = _existing_folder(named.parent) if named.parent != named else None
    if parent is None or named.name.isascii():
        return None
    return next(
        (
            folder
            for folder in sorted(parent.iterdir())
            if folder.is_dir() and _composed(folder.name) == _composed(named.name)
        ),
        None,
    )


@lru_cache(maxsize=16)
def _by_spelling(folder: str, changed: int) -> dict[str, str]:
    names = sorted(file.name for file in Path(folder).iterdir() if file.is_file())
    return {_spelling(name): name for name in reversed(names)}


@lru_cache(maxsize=16)
def _by_case(folder: str, changed: int) -> dict[str, str]:
    names = sorted(path.name for path in Path(folder).iterdir())
    return {name.casefold(): name for name in reversed(names)}


def _spelling(name: str) -> str:
    """A name with a suffix in small letters, and as ``_composed``."""
    return _composed(Path(name).stem + Path(name).suffix.lower())


def _composed(name: str) -> str:
    """A name whose accents are on their letters."""
    return unicodedata.normalize("NFC", name)


class Copies:
    """Finds the counterparts of a capture's images in another folder, by as much of their paths as it has.

    ``images/cam1/000.png`` may be ``cam1/000.png`` there, or ``000.png``; but an end of a path that two of
    the images have in common says nothing, and is never used.

    Args:
        names: of all images, as paths with slashes; two of one name are the same image.
    """

    def __init__(self, names: Iterable[str]):
        shared: Counter[tuple[str, ...]] = Counter()
        for parts in {_parts(name) for name in names}:
            shared.update((*tail[:-1], Path(tail[-1]).stem) for tail in _tails(parts))
        self._shared = shared

    def find(self, folder: Path, name: str, file: Callable[[Path], Path | None] = existing) -> Path | None:
        """The counterpart of the image ``name`` in ``folder``; None if there is none that is surely its own.

        Args:
            file: the file that stands for a path in that folder, or None.
        """
        for tail in _tails(_parts(name)):
            if self._shared[(*tail[:-1], Path(tail[-1]).stem)] > 1:
                return None  # shorter tails are shared as well
            if len(tail) == 1 or (folder / tail[0]).is_dir():
                found = file(folder.joinpath(*tail))
                if found is not None:
                    return found
        return None


def _parts(name: str) -> tuple[str, ...]:
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return tuple(part for part in parts if part not in ("/", ".", "..") and not part.endswith(":"))


def _tails(parts: tuple[str, ...]) -> list[tuple[str, ...]]:
    return [parts[start:] for start in range(len(parts))]
