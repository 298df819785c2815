"""The folder of a fit: can it be written, and what of an earlier fit is in it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from ..errors import UserError

#: What an earlier fit may have left in a folder; nothing else is ever deleted.
_OWN_FILES = ("scene.xml", "mesh.ply", "template.ply", "light.exr", "metrics.json", "log.jsonl",
              "checkpoint.npz", "views", "mesh.glb", "report.html")


def check_output_folder(output: Path, *, keep: bool, overwrite: bool) -> None:
    """Checks, without a trace, that ``make_output_folder`` will succeed.

    Args:
        keep: the files of an earlier fit are welcome (resuming).
        overwrite: they may be deleted.

    Raises:
        UserError: the folder cannot be made or written, or holds an earlier fit.
    """
    existing = next(path for path in (output, *output.absolute().parents) if os.path.lexists(path))
    if not existing.is_dir():
        raise UserError(f"Output folder '{output}' cannot be made because '{existing}' is a file; "
                        f"choose another one with -o.")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise UserError(f"Output folder '{output}' cannot be written (no permission in '{existing}'); choose "
                        f"another one with -o.")
    earlier = _earlier(output)
    if earlier and not keep and not overwrite:
        raise UserError(f"'{output}' holds an earlier fit ({earlier[0].name}); continue it with --resume, "
                        f"replace it with --overwrite or choose another folder with -o.")


def make_output_folder(output: Path, *, keep: bool) -> None:
    """Makes the folder; deletes the files of an earlier fit in it unless ``keep``.

    Raises:
        UserError: the folder cannot be made or written.
    """
    try:
        output.mkdir(parents=True, exist_ok=True)
        probe = output / ".write_test"
        probe.write_bytes(b"")
        probe.unlink()
        for path in [] if keep else _earlier(output):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    except OSError as error:
        raise UserError(f"Output folder '{output}' cannot be written ({error.strerror}); "
                        f"choose another one with -o.") from error


def _earlier(output: Path) -> list[Path]:
    return [output / name for name in _OWN_FILES if (output / name).exists()]
