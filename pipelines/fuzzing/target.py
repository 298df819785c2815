"""What a fuzzed reader is: good inputs, copies of them that are damaged, and what must not happen then."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from random import Random

from gshell_mi.errors import UserError

from .mutators import damage_file


class Broken(Exception):
    """What must not happen has happened, short of a crash."""


class Target:
    """Something that reads files.

    Args:
        write: makes good inputs in a folder.
        attempt: reads them; raises nothing but ``UserError``.
        files: patterns of those that are damaged.
        keeps: what the reader may leave in the folder although it refuses: names begin so.
        damage: how a file is damaged.
    """

    def __init__(
        self,
        write: Callable[[Path], object],
        attempt: Callable[[Path], object],
        *files: str,
        keeps: str | None = None,
        damage: Callable[[Path, Random], None] = damage_file,
    ):
        self._write, self._attempt, self._files = write, attempt, files
        self._keeps, self._damage = keeps, damage

    def prepare(self, folder: Path) -> None:
        """Writes the good inputs, and checks that they are good."""
        folder.mkdir(parents=True)
        self._write(folder)
        self._attempt(self._copy(folder, folder.parent / "good"))

    def try_one(self, folder: Path, seed: str) -> str:
        """Tries a damaged copy of the inputs in ``folder``; "ok" or "refused".

        Raises:
            Exception: whatever should not have happened.
        """
        random = Random(seed)
        place = self._copy(folder, folder.parent / "try")
        candidates = sorted(path for pattern in self._files for path in place.rglob(pattern))
        damaged = random.choice(candidates)
        self._damage(damaged, random)
        before = _tree(place.parent)
        try:
            self._attempt(place)
        except UserError as error:
            if not str(error).strip() or "Traceback" in str(error):
                raise Broken(f"no sentence: {error}") from error
            left = {path for path in _tree(place.parent) - before if not self._kept(path)}
            if left:
                raise Broken(f"left behind after a refusal: {sorted(left)[:3]}") from error
            return "refused"
        new = _tree(place.parent) - before
        if outside := {path for path in new if not path.startswith("try/out")}:
            raise Broken(f"written outside of the output: {sorted(outside)[:3]}")
        if half := {path for path in new if _is_hidden(path)}:
            raise Broken(f"half-written: {sorted(half)[:3]}")
        return "ok"

    def _kept(self, path: str) -> bool:
        return self._keeps is not None and path.startswith(f"try/{self._keeps}") and not _is_hidden(path)

    @staticmethod
    def _copy(source: Path, goal: Path) -> Path:
        shutil.rmtree(goal, ignore_errors=True)
        shutil.copytree(source, goal)
        return goal


def _tree(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def _is_hidden(path: str) -> bool:
    """Whether a file is one that is being written, or lies in a folder that is."""
    return any(part.startswith(".") for part in path.split("/"))


def command(main: Callable[[list[str]], int], *arguments: object) -> None:
    """Runs a command in this process; ``UserError`` with what it told if it refuses."""
    told = io.StringIO()
    with redirect_stderr(told), redirect_stdout(io.StringIO()):
        code = main([*map(str, arguments)])
    if code == 2:
        raise UserError(told.getvalue())
    if code != 0:
        raise Broken(f"exit code {code}: {told.getvalue()}")
