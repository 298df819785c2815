"""The state of a running fit, written so that a kill at any moment leaves a whole file behind."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...errors import UserError
from ...files import replacing

#: Raised when the meaning of the arrays changes.
FORMAT = 3


@dataclass
class Checkpoint:
    """Where a fit stands.

    Attributes:
        stage: name of the stage that is running or next.
        iteration: its steps that are done.
        arrays: everything else, by name.
        seconds: time spent per stage so far.
        config: the configuration, as JSON-able values.
        facts: what stages found out that belongs into the metrics, as JSON-able values.
    """

    stage: str
    iteration: int
    config: dict
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    facts: dict[str, bool] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Writes the file beside its place and moves it there in one step.

        Raises:
            UserError: the folder is full or not writable; an older checkpoint stays as it was.
        """
        header = json.dumps({"format": FORMAT, "stage": self.stage, "iteration": self.iteration,
                             "config": self.config, "seconds": self.seconds, "facts": self.facts})
        try:
            with replacing(path) as partial, open(partial, "wb") as file:
                np.savez(file, header=np.array(header), **self.arrays)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise UserError(f"Checkpoint '{path}' cannot be written ({error.strerror}); free some space or "
                            f"choose another folder with -o, then continue with --resume.") from error

    @classmethod
    def load(cls, path: Path) -> Checkpoint:
        """Reads a checkpoint.

        Raises:
            UserError: it is missing, damaged or of another version.
        """
        if not path.is_file():
            raise UserError(f"There is no checkpoint '{path}' to resume from; start without --resume.")
        try:
            with np.load(path) as stored:
                arrays = {name: stored[name] for name in stored.files}
            header = json.loads(str(arrays.pop("header")))
        except Exception as error:
            raise UserError(f"Checkpoint '{path}' is damaged ({type(error).__name__}); delete it and start "
                            f"without --resume.") from error
        if header.pop("format") != FORMAT:
            raise UserError(f"Checkpoint '{path}' was written by another version of gshell_mi; start without "
                            f"--resume.")
        return cls(arrays=arrays, **header)


def optimizer_arrays(name: str, optimizer: mi.ad.Adam) -> dict[str, np.ndarray]:
    """The values, moments and step counts of an Adam optimiser, as host arrays."""
    arrays = {}
    for key, (value, _, _, (step, first, second, _)) in optimizer.state.items():
        for part, array in (("value", value), ("step", step), ("first", first), ("second", second)):
            arrays[f"{name}/{key}/{part}"] = np.array(dr.detach(array))
    return arrays


def restore_optimizer(name: str, optimizer: mi.ad.Adam, arrays: Mapping[str, np.ndarray]) -> None:
    """Puts back what ``optimizer_arrays`` saved into an optimiser with the same parameters."""
    for key, (value, promoted, rate, (step, first, second, maximum)) in list(optimizer.state.items()):
        stored = {part: arrays[f"{name}/{key}/{part}"] for part in ("value", "step", "first", "second")}
        restored = type(value)(stored["value"])
        dr.enable_grad(restored)
        step, first, second = (type(old)(stored[part])
                               for old, part in ((step, "step"), (first, "first"), (second, "second")))
        optimizer.state[key] = (restored, promoted, rate, (step, first, second, maximum))
