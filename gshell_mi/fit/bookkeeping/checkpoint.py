"""The state of a running fit, written so that a kill at any moment leaves a whole file behind."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ...errors import UserError
from ...files import replacing

#: Raised when the meaning of the arrays changes.
FORMAT = 7

#: What comes after the last stage.
DONE = "done"


@dataclass
class Checkpoint:
    """Where a fit stands.

    Attributes:
        stage: name of the stage that is running or next; empty before the first, ``DONE`` after the last.
        iteration: its steps that are done.
        arrays: everything else, by name.
        seconds: time spent per stage so far.
        config: the configuration, as JSON-able values.
        facts: what stages found out that belongs into the metrics, as JSON-able values.
        inputs: what the fit was started with (``fingerprint``).
    """

    stage: str
    iteration: int
    config: dict
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, Any] = field(default_factory=dict)

    def part(self, prefix: str) -> dict[str, np.ndarray]:
        """The arrays whose names have a prefix, without it."""
        found = {
            name.removeprefix(prefix): array for name, array in self.arrays.items() if name.startswith(prefix)
        }
        return _Arrays(found, self.arrays.path) if isinstance(self.arrays, _Arrays) else found

    def save(self, path: Path) -> None:
        """Writes the file beside its place and moves it there in one step.

        Raises:
            UserError: the folder is full or not writable; an older checkpoint stays as it was.
        """
        header = json.dumps(
            {
                "format": FORMAT,
                "stage": self.stage,
                "iteration": self.iteration,
                "config": self.config,
                "seconds": self.seconds,
                "facts": self.facts,
                "inputs": self.inputs,
                "arrays": {name: _kind(array) for name, array in self.arrays.items()},
            }
        )
        try:
            with replacing(path) as partial, open(partial, "wb") as file:
                np.savez(file, header=np.array(header), **dict[str, Any](self.arrays))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise UserError(
                f"Checkpoint '{path}' cannot be written ({error.strerror}); free some space or "
                f"choose another folder with -o, then continue with --resume."
            ) from error

    @classmethod
    def load(cls, path: Path) -> Checkpoint:
        """Reads a checkpoint.

        Raises:
            UserError: it is missing, damaged or of another version.
        """
        if not path.is_file():
            raise UserError(f"There is no checkpoint '{path}' to resume from; start without --resume.")
        try:
            with open(path, "rb") as file:
                header, arrays = _read(file)
        except PermissionError as error:
            raise UserError(
                f"Checkpoint '{path}' cannot be read ({error.strerror}); mend its permissions."
            ) from error
        except Exception as error:
            raise _damaged(path, type(error).__name__) from error
        if header.pop("format", None) != FORMAT:
            raise UserError(
                f"Checkpoint '{path}' was written by another version of gshell_mi; start without --resume."
            )
        if problem := _problem(header, arrays):
            raise _damaged(path, problem)
        return cls(arrays=_Arrays(arrays, path), **header)


class _Arrays(dict):
    """The arrays of a checkpoint; one that is not there is the file's fault."""

    def __init__(self, arrays: Mapping[str, np.ndarray], path: Path):
        super().__init__(arrays)
        self.path = path

    def __missing__(self, name: str) -> np.ndarray:
        raise _damaged(self.path, f"it lacks '{name}'")


def _damaged(path: Path, why: str) -> UserError:
    return UserError(f"Checkpoint '{path}' is damaged ({why}); delete it and start without --resume.")


def _read(file: BinaryIO) -> tuple[dict, dict[str, np.ndarray]]:
    """Header and arrays; any exception of damaged files."""
    with zipfile.ZipFile(file) as archive:
        # Ours are not compressed; others may unpack to more than there is memory.
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise ValueError("compressed")
    file.seek(0)
    with np.load(file, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    header = json.loads(str(arrays.pop("header")))
    if not isinstance(header, dict):
        raise TypeError("the header is no object")
    return header, arrays


def _problem(header: dict, arrays: dict[str, np.ndarray]) -> str | None:
    """What a header lacks that ``Checkpoint.save`` writes; ``arrays`` is taken out of it."""
    expected = header.pop("arrays", None)
    kinds = {"stage": str, "iteration": int, "config": dict, "seconds": dict, "facts": dict, "inputs": dict}
    if header.keys() != kinds.keys():
        return "its header has other entries"
    for name, kind in kinds.items():
        if type(header[name]) is not kind:
            return f"'{name}' is no {kind.__name__}"
    if not header["stage"] or header["iteration"] < 0:
        return "its header names no step of a fit"
    if not all(type(value) in (int, float) for value in header["seconds"].values()):
        return "'seconds' are no numbers"
    if not all(isinstance(header["inputs"].get(name, {}), dict) for name in ("views", "targets")):
        return "'inputs' are no digests"
    if any(array.dtype.kind not in "biuf" for array in arrays.values()):
        return "an array holds no numbers"
    if expected != {name: _kind(array) for name, array in arrays.items()}:
        return "its arrays are not those of its header"
    return None


def _kind(array: Any) -> str:
    array = np.asarray(array)
    return f"{array.dtype.str}{list(array.shape)}"
