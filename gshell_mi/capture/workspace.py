"""A folder beside the scene in which slow steps keep what they made, so that none is done twice."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

from ..errors import UserError
from ..files import replacing
from ..own_folder import TAG, is_own_file

#: Called with (what is being done, steps done, steps in all).
Progress = Callable[[str, int, int], None]

#: Tells that a folder was made here.
_MARK = "steps.json"


class Workspace:
    """A folder of a sub-folder per step.

    Args:
        path: the folder, made when the first step needs it.

    Raises:
        UserError: there is a folder of that name, with other things in it.
    """

    def __init__(self, path: Path):
        self.path = path
        if path.exists() and not is_own_file(path / _MARK) and (not path.is_dir() or any(path.iterdir())):
            raise UserError(
                f"'{path}', where the steps before a scene are kept, was not made by "
                f"gshell_mi.capture; move it away or choose another output."
            )

    def step(self, name: str, job: dict) -> Path:
        """The folder of a step; empty if it was last used for another job.

        Args:
            name: of the folder.
            job: what the step's results depend on, as for JSON; written into its ``job.json``.

        Raises:
            UserError: the folder cannot be written.
        """
        folder, text = self.path / name, json.dumps(job, indent=1, sort_keys=True)
        try:
            if (folder / "job.json").is_file() and (folder / "job.json").read_text(encoding="utf-8") == text:
                return folder
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            with replacing(self.path / _MARK) as partial:
                partial.write_text(f'{{"note": "{TAG}.capture; safe to delete"}}\n', encoding="utf-8")
            with replacing(folder / "job.json") as partial:
                partial.write_text(text, encoding="utf-8")
        except OSError as error:
            raise UserError(
                f"'{folder}' cannot be written ({error.strerror or error}); free some space, "
                f"mend its permissions or choose another output."
            ) from error
        return folder


def fingerprint(files: list[Path]) -> list[list]:
    """What tells a changed file: name, size and time of change of each."""
    return [[str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns] for path in files]
