"""Folders that runs of this package write: what wrote them, which files, and what may be replaced."""

from __future__ import annotations

import json
import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path

from . import __version__
from .errors import UserError
from .files import locked, remove_stale, replacing
from .json_files import read_json

#: The file that marks a folder as ours.
MARK = "gshell_mi.json"

#: What tells that a single file is ours: its bytes hold this.
TAG = "written by gshell_mi"

#: The names that runs of each kind may write. A mark may be a stranger's: it is believed in these alone.
KINDS = {
    "fit": (
        "scene.xml",
        "mesh.ply",
        "template.ply",
        "light.exr",
        "metrics.json",
        "log.jsonl",
        "checkpoint.npz",
        "mesh.glb",
        "report.html",
        "mesh.obj",
        "mesh.mtl",
        "mesh_base_color.png",
        "mesh_roughness.png",
        "mesh_metallic.png",
        "mesh_normal.png",
        "remeshed.ply",
        "views/*.png",
        "held_out/*.png",
        "masks/*.png",
    ),
    "capture": (
        "sensors.xml",
        "test.xml",
        "capture.json",
        "check.png",
        "light.*",
        "view_*.exr",
        "test/test_*.exr",
    ),
    "dataset": ("dataset.json", "statistics.json", "sheet.png", "shards/*.npz"),
    "model": ("model.json", "weights.safetensors", "checkpoint.safetensors", "log.jsonl", "samples/*.png"),
    "generate": (
        "samples.json",
        "sheet.png",
        "fields.npz",
        "interpolation.mp4",
        "interpolation.gif",
        "meshes/*.ply",
        "meshes/*.glb",
    ),
    "batch": ("batch.json", "results.jsonl", "results.html"),
}

#: Bytes at either end of a file in which its tag is looked for.
_ENDS = 1 << 20


class OwnFolder:
    """A folder with a mark, ``gshell_mi.json``: the kind of run that writes it, and the files written.

    Only files that the mark lists are ever replaced or removed; whatever else lies there is somebody's, and
    is never touched.

    Args:
        path: the folder, which need not exist.
        kind: of the runs that write it, one of ``KINDS``.
    """

    def __init__(self, path: Path, kind: str):
        self.path, self.kind = Path(path), kind

    @property
    def files(self) -> set[str]:
        """The names that the mark lists, whether the files are still there or not; with / between folders."""
        return self._listed(self._read().get("files"))

    def present(self) -> list[str]:
        """Those of ``files`` that are there."""
        return sorted(
            name for name in self.files if self._in_the_way(name) is None and _is_file(self.path / name)
        )

    def is_marked(self) -> bool:
        return self._read().get("kind") == self.kind

    def lists_beside(self, name: str) -> bool:
        """Whether the mark lists the file ``name`` beside the folder as well."""
        return self.is_marked() and self._read().get("beside") == name

    def check_kind(self) -> None:
        """Raises ``UserError`` if runs of another kind write the folder."""
        kind = self._read().get("kind", self.kind)
        if kind != self.kind:
            raise UserError(f"'{self.path}' was written by gshell_mi.{kind}; choose another place with -o.")

    def foreign(self, names: Iterable[str]) -> Path | None:
        """The first thing in the folder that is where a file of ours would be, but is none of ours."""
        own = self.files
        for name in sorted(names):
            if path := self._in_the_way(name):
                return path
            if os.path.lexists(self.path / name) and name not in own:
                return self.path / name
        return None

    def check_free(self, names: Iterable[str]) -> None:
        """Raises ``UserError`` if a file that is none of ours is in the way of one of ``names``."""
        path = self.foreign(names)
        if path is not None:
            raise UserError(
                f"'{path}' is in the way: gshell_mi.{self.kind} has not written it there (or "
                f"'{MARK}' does not say so), so it is left alone; move it away or choose "
                f"another place with -o."
            )

    def check_inputs(self, inputs: Iterable[Path], names: Iterable[str] = ()) -> None:
        """Raises ``UserError`` if a file that is read is one that will be written or removed: one of those in
        ``files`` or ``names``."""
        own = {key: name for name in self.files.union(names) if (key := _key(self.path / name, link=True))}
        for path in sorted(inputs):
            if _key(path) in own:
                raise UserError(
                    f"'{path}' is read by this run and would be replaced by it; choose another place with -o."
                )

    def claim(self, *names: str) -> None:
        """Lists files that are about to be written.

        Raises:
            UserError: something in the way is none of ours, or the folder cannot be written.
        """
        self.check_kind()
        self.check_free(names)
        files = self.files
        if not files.issuperset(names):
            self.write_mark(files.union(names), self._read().get("beside"))

    def write_mark(self, files: Iterable[str], beside: str | None = None) -> None:
        mark = {"kind": self.kind, "version": __version__, "files": sorted(files)}
        text = json.dumps(mark | ({"beside": beside} if beside else {}), indent=1) + "\n"
        try:
            with replacing(self.path / MARK) as partial:
                partial.write_text(text, encoding="utf-8")
        except OSError as error:
            raise UserError(
                f"'{self.path}' cannot be written ({error.strerror or error}); mend its "
                f"permissions or choose another place with -o."
            ) from error

    def take_over(self, staged: Path, last: str, beside: str | None = None) -> None:
        """Moves the files of a folder inside or beside this one into it, and removes those of ours that have
        no successor. Each file is whole at any moment, and the mark lists both until the old ones are gone.

        Args:
            staged: a folder on the same disk; its files go.
            last: the file that is moved last, so that a kill in between leaves it where it was.
            beside: what the mark shall list beside the folder.

        Raises:
            UserError: a file that is none of ours is in the way; then nothing has changed.
        """
        new = {path.relative_to(staged).as_posix() for path in staged.rglob("*") if path.is_file()} - {MARK}
        self.check_free(new)
        old = set(self.present())
        self.check_writable(old)
        self.write_mark(old | new, beside)
        for name in sorted(new, key=lambda name: (name == last, name)):
            (self.path / name).parent.mkdir(exist_ok=True)
            os.replace(staged / name, self.path / name)
            if (staged / name).parent != staged:
                remove_empty((staged / name).parent)
        self._remove(old - new)
        self.write_mark(new, beside)

    def check_writable(self, names: Iterable[str]) -> None:
        """Raises ``UserError`` if one of the files cannot be replaced or removed."""
        for folder in sorted({(self.path / name).parent for name in names}):
            if _is_folder(folder) and not os.access(folder, os.W_OK | os.X_OK):
                raise UserError(
                    f"'{folder}' cannot be written (Permission denied); mend its permissions or "
                    f"choose another place with -o."
                )

    def clear(self, keep: Iterable[str] = ()) -> None:
        """Removes the files of ours but ``keep``."""
        kept = set(keep) & set(self.present())
        self._remove(set(self.present()) - kept)
        self.write_mark(kept)

    def remove(self) -> None:
        """Removes the files of ours, the mark, and the folder if nothing else is in it."""
        self._remove(self.present())
        if self.is_marked():
            (self.path / MARK).unlink()
        remove_empty(self.path)

    def _in_the_way(self, name: str) -> Path | None:
        """What is no file at a name, or no folder on the way to it; a link is neither."""
        path = self.path / name
        for folder in Path(name).parents[:-1]:
            if os.path.lexists(self.path / folder) and not _is_folder(self.path / folder):
                return self.path / folder
        return path if os.path.lexists(path) and not _is_file(path) else None

    def _remove(self, names: Iterable[str]) -> None:
        for name in names:
            (self.path / name).unlink(missing_ok=True)
            if (self.path / name).parent != self.path:
                remove_empty((self.path / name).parent)

    def _read(self) -> dict:
        try:
            mark = read_json(self.path / MARK)
        except (OSError, ValueError):
            return {}
        return mark if isinstance(mark, dict) and mark.get("kind") in tuple(KINDS) else {}

    def _listed(self, files: object) -> set[str]:
        if not self.is_marked() or not isinstance(files, list):
            return set()
        return {name for name in files if isinstance(name, str) and _fits(name, KINDS[self.kind])}


@contextmanager
def own_folder(path: Path, kind: str) -> Iterator[OwnFolder]:
    """A folder of ours that exists, locked against other runs and freed of what killed ones left.

    Raises:
        UserError: another run writes into it, it is of another kind, or something in it cannot be written.
    """
    folder = OwnFolder(path, kind)
    if not folder.path.is_dir():
        raise UserError(f"'{path}' is no folder; check the path.")
    try:
        with locked(folder.path):
            folder.check_kind()
            remove_stale(folder.path)
            yield folder
    except OSError as error:
        raise UserError(
            f"'{error.filename or path}' cannot be read or written ({error.strerror or error}); "
            f"free some space or mend its permissions."
        ) from error


def is_own_file(path: Path) -> bool:
    """Whether a file is there that carries our ``TAG``, near its start or its end."""
    if not _is_file(path):
        return False
    with open(path, "rb") as file:
        start = file.read(_ENDS)
        file.seek(max(0, os.fstat(file.fileno()).st_size - _ENDS))
        return TAG.encode() in start or TAG.encode() in file.read()


def check_own_file(path: Path, *, option: str = "-o") -> None:
    """Raises ``UserError`` if there is something at ``path`` that is no file of ours.

    Args:
        option: that names another place.
    """
    if os.path.lexists(path) and not is_own_file(path):
        raise UserError(
            f"'{path}' exists and was not written by gshell_mi, so it is left alone; move it "
            f"away or choose another place with {option}."
        )


def remove_empty(folder: Path) -> None:
    """Removes a folder if nothing is in it."""
    try:
        folder.rmdir()
    except OSError:
        pass


def remove_tree(folder: Path) -> None:
    """Removes a working folder of ours with all that is in it; a link is removed, not what it leads to."""
    if _is_folder(folder):
        shutil.rmtree(folder, ignore_errors=True)
    else:
        folder.unlink(missing_ok=True)


def _fits(name: str, patterns: Iterable[str]) -> bool:
    parts = name.split("/")
    return (
        not {"", ".", ".."}.intersection(parts)
        and "\\" not in name
        and any(
            len(parts) == len(split := pattern.split("/")) and all(map(fnmatchcase, parts, split))
            for pattern in patterns
        )
    )


def _is_file(path: Path) -> bool:
    """Whether it is a file itself, no link to one."""
    try:
        return stat.S_ISREG(os.lstat(path).st_mode)
    except OSError:
        return False


def _is_folder(path: Path) -> bool:
    try:
        return stat.S_ISDIR(os.lstat(path).st_mode)
    except OSError:
        return False


def _key(path: Path, *, link: bool = False) -> tuple[int, int] | None:
    """What identifies a file, under whatever name; None if there is none."""
    try:
        found = os.lstat(path) if link else os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino
