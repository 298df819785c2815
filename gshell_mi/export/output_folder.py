"""The folder of a fit while it runs: an earlier fit in it stays whole until the new one is."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

from ..errors import UserError
from ..files import locked, remove_stale
from ..own_folder import KINDS, MARK, OwnFolder
from .views import view_files

#: Where a fit works as long as an earlier one is in the folder.
_UNFINISHED = ".unfinished"

#: What a fit goes on from.
CHECKPOINT, LOG = "checkpoint.npz", "log.jsonl"

#: What a fit may write whatever its scene; the names of views depend on that.
_FIXED = tuple(name for name in KINDS["fit"] if "*" not in name)


class FitFolder:
    """Context of a fit that writes into a folder: no other run may, and what is not a fit's is left alone.

    Args:
        output: the folder, which need not exist.
        resume: a fit goes on whose checkpoint is there.
        overwrite: an earlier fit may be replaced; its files go when all of the new one are there.

    Attributes:
        place: where the fit works: ``output`` or, while an earlier fit is in that, a hidden folder in it.

    Raises:
        UserError: the folder cannot be made or written, another run writes into it, it holds an earlier fit,
            or files that are none of a fit's are in the way.
    """

    def __init__(self, output: Path, *, resume: bool, overwrite: bool):
        self.output, self.place = Path(output), Path(output)
        self._resume, self._overwrite = resume, overwrite
        self._names: list[str] = list(_FIXED)
        self._stack = ExitStack()

    def __enter__(self) -> FitFolder:
        """Checks, without a trace, that the folder can be used."""
        existing = next(
            path for path in (self.output, *self.output.absolute().parents) if os.path.lexists(path)
        )
        if not existing.is_dir():
            raise UserError(
                f"Output folder '{self.output}' cannot be made because '{existing}' is a file; "
                f"choose another one with -o."
            )
        if not os.access(existing, os.W_OK | os.X_OK):
            raise UserError(
                f"Output folder '{self.output}' cannot be written (no permission in "
                f"'{existing}'); choose another one with -o."
            )
        with ExitStack() as stack:
            if self.output.is_dir():
                stack.enter_context(locked(self.output))
            self._choose_place()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def check(self, inputs: Iterable[Path], views: Iterable[str], held_out: Iterable[str] = ()) -> None:
        """Checks, without a trace, what depends on the scene.

        Args:
            inputs: the files that the fit reads.
            views: ids of the training views.
            held_out: ids of the views held out.

        Raises:
            UserError: an input is a file that the fit would replace, or as in the class.
        """
        self._names = [*_FIXED, *view_files(views, held_out)]
        own = OwnFolder(self.output, "fit")
        own.check_inputs(inputs, self._names)
        self._check_free(own)

    def prepare(self) -> None:
        """Makes the folder and the place to work in it, once all else is known to be in order.

        Raises:
            UserError: as in the class.
        """
        own = OwnFolder(self.output, "fit")
        try:
            self.output.mkdir(parents=True, exist_ok=True)
            self._stack.enter_context(locked(self.output))
            self._choose_place()  # another run may have been here before the lock
            own.check_writable([*own.present(), MARK])
            remove_stale(self.output)
            if self.place != self.output:
                self.place.mkdir(exist_ok=True)
            elif os.path.lexists(self.output / _UNFINISHED):  # killed when all but that was done
                OwnFolder(self.output / _UNFINISHED, "fit").remove()
            place = OwnFolder(self.place, "fit")
            if not self._resume:
                place.clear(keep=(CHECKPOINT,))  # which the new one replaces
            place.write_mark(place.files | {CHECKPOINT, LOG})
        except OSError as error:
            raise UserError(
                f"Output folder '{self.output}' cannot be written ({error.strerror or error}); "
                f"choose another one with -o."
            ) from error

    def finish(self) -> None:
        """Puts the fit in the place of the earlier one, if there is one."""
        if self.place != self.output:
            remove_stale(self.place)  # what a kill has left there just before this run began
            OwnFolder(self.output, "fit").take_over(self.place, last=CHECKPOINT)
            OwnFolder(self.place, "fit").remove()
            self.place = self.output

    def _choose_place(self) -> None:
        own = OwnFolder(self.output, "fit")
        own.check_kind()
        unfinished = OwnFolder(self.output / _UNFINISHED, "fit")
        if self._resume:
            self.place = unfinished.path if CHECKPOINT in unfinished.present() else self.output
            self._check_free(own)
            return
        self._check_free(own)
        earlier = [*own.present(), *unfinished.present()]
        if earlier and not self._overwrite:
            raise UserError(
                f"'{self.output}' holds an earlier fit ({earlier[0]}); continue it with "
                f"--resume, replace it with --overwrite or choose another folder with -o."
            )
        self.place = unfinished.path if earlier else self.output

    def _check_free(self, own: OwnFolder) -> None:
        # A checkpoint that could be read says itself that a fit wrote it.
        adopted = {CHECKPOINT, LOG} if self._resume else set()
        own.check_free(set(self._names) - adopted)
        unfinished = self.output / _UNFINISHED
        if os.path.lexists(unfinished):
            if unfinished.is_symlink() or not OwnFolder(unfinished, "fit").is_marked():
                raise UserError(
                    f"'{unfinished}' is in the way and was not made by a fit; move it away or "
                    f"choose another folder with -o."
                )
            OwnFolder(unfinished, "fit").check_free(self._names)


def can_resume(output: Path) -> bool:
    """Whether the fit that wrote into the folder last has left a checkpoint."""
    unfinished = OwnFolder(Path(output) / _UNFINISHED, "fit")
    return CHECKPOINT in (unfinished if unfinished.is_marked() else OwnFolder(output, "fit")).present()
