"""Where an import works: all of it takes its place at the end, or nothing does."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ..errors import UserError
from ..files import locked, name_trouble
from ..own_folder import OwnFolder, is_own_file, remove_tree


@dataclass(frozen=True)
class Staging:
    """A temporary folder that becomes ``output`` (an XML file) and the folder of its stem.

    Attributes:
        path: to write that file and that folder into.
        output: the file's final place.
    """

    path: Path
    output: Path

    def check_inputs(self, inputs: Iterable[Path]) -> None:
        """Raises ``UserError`` if one of the files that the import reads would be replaced by it."""
        _own(self.output).check_inputs(inputs, [f"../{self.output.name}"])


@contextmanager
def staged(output: Path, *, overwrite: bool, source: Path) -> Iterator[Staging]:
    """A temporary folder for what becomes ``output`` and the folder of its stem when the block ends.

    If it fails, nothing remains and what was there before is untouched. Only files that an earlier import
    wrote are ever replaced.

    Raises:
        UserError: something is there already and may not be replaced, or the place cannot be written.
    """
    try:
        _check(output, overwrite=overwrite, source=source)
        output.parent.mkdir(parents=True, exist_ok=True)
        # On the same disk, so that moving it into place is a mere renaming.
        with _working_folder(output.parent / f".{output.stem}.partial") as partial:
            (partial / output.stem).mkdir()
            yield Staging(partial, output)
            _put_in_place(partial, output)
    except OSError as error:
        raise UserError(
            f"'{output}' cannot be written ({error.strerror or error}); free some space, mend "
            f"its permissions or choose another output."
        ) from error


def _own(output: Path) -> OwnFolder:
    return OwnFolder(output.with_suffix(""), "capture")


def _check(output: Path, *, overwrite: bool, source: Path) -> None:
    if output.suffix != ".xml":
        raise UserError(
            f"The output '{output}' must end in .xml; the targets go into a folder of the same "
            f"name beside it."
        )
    if trouble := name_trouble(output.name):
        raise UserError(f"The name of the output '{str(output)[:80]}' {trouble}; choose another name.")
    own, folder = _own(output), output.with_suffix("")
    if folder.exists() and folder.resolve() in (source.resolve(), *source.resolve().parents):
        raise UserError(
            f"The output '{output}' would put its targets into '{folder}', where the capture is; "
            f"choose another name."
        )
    there = next((path for path in (output, folder) if os.path.lexists(path)), None)
    if there is not None and not overwrite:
        raise UserError(f"'{there}' exists; replace it with --overwrite, or choose another output.")
    for path, ours in (
        (folder, own.is_marked() and not folder.is_symlink()),
        (output, own.lists_beside(output.name) and not output.is_symlink()),
    ):
        if os.path.lexists(path) and not ours:
            raise UserError(
                f"'{path}' was not written by gshell_mi.capture, so --overwrite leaves it alone; "
                f"move it away or choose another output."
            )


@contextmanager
def _working_folder(path: Path) -> Iterator[Path]:
    """A new folder, locked; what a killed run has left in its place goes."""
    while True:
        path.mkdir(exist_ok=True)
        if path.is_symlink():
            raise UserError(f"'{path}' is in the way and is a link; remove it.")
        with locked(path):
            # Whoever held the lock before may have removed the folder meanwhile.
            if not path.is_dir():
                continue
            for entry in path.iterdir():
                remove_tree(entry)
            try:
                yield path
            finally:
                remove_tree(path)
            return


def _put_in_place(partial: Path, output: Path) -> None:
    new, folder, own = partial / output.stem, output.with_suffix(""), _own(output)
    files = [path.relative_to(new).as_posix() for path in new.rglob("*") if path.is_file()]
    if not folder.exists():
        OwnFolder(new, "capture").write_mark(files, output.name)
        os.replace(new, folder)
    else:
        own.check_free(files)
        if is_own_file(folder / "check.png"):  # the picture of the earlier views
            own.write_mark(own.files | {"check.png"}, output.name)
        # Without the scene, nobody takes a folder that is half new for a whole one.
        if output.exists():
            os.replace(output, partial / "earlier.xml")
        own.take_over(new, last="capture.json", beside=output.name)
    os.replace(partial / output.name, output)
