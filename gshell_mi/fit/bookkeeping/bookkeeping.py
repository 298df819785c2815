"""What a fit keeps on disk while it runs: its checkpoint, its log, and how long each stage took."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import mitsuba as mi
import numpy as np

from ...files import replacing
from ...interrupt import Interrupt
from .checkpoint import STAGES, Checkpoint, optimizer_arrays, restore_optimizer
from .observer import Observer, Preview
from .progress import Progress

#: Between two checkpoints at least this many times what writing one takes.
_CHECKPOINT_PAUSE = 10


class Worker(Protocol):
    """A stage that goes in steps."""

    def step(self, iteration: int) -> Mapping[str, float]:
        """One step; returns what is logged."""

    def preview(self) -> Preview:
        """The surface as it is."""


class Bookkeeping:
    """Runs the steps of stages, and writes down where they are.

    Args:
        output: the fit's folder, which ``checkpoint.npz`` and ``log.jsonl`` are written to.
        checkpoint: where the fit stands; kept up to date.
        checkpoint_seconds: least time between two checkpoints within a stage.
        observer: is told of every step.
    """

    def __init__(self, output: Path, checkpoint: Checkpoint, checkpoint_seconds: float, progress: Progress,
                 interrupt: Interrupt, observer: Observer | None):
        self.checkpoint, self.checkpoint_seconds = checkpoint, checkpoint_seconds
        self.progress, self.interrupt, self.observer = progress, interrupt, observer
        self._path, self._log = checkpoint_path(output), output / "log.jsonl"

    def enter(self, stage: str, **arrays: np.ndarray) -> None:
        """Starts a stage from ``arrays``."""
        self.checkpoint.stage, self.checkpoint.iteration, self.checkpoint.arrays = stage, 0, arrays
        self.checkpoint.save(self._path)

    def leave(self) -> None:
        """The last stage has ended; its arrays stay."""
        self.checkpoint.stage = STAGES[-1]
        self.checkpoint.save(self._path)

    def iterate(self, stage: str, count: int, worker: Worker, optimizers: Mapping[str, mi.ad.Adam],
                constants: Mapping[str, np.ndarray],
                variables: Callable[[], dict[str, np.ndarray]] = dict,
                stalled: Callable[[int], bool] = lambda done: False) -> None:
        """Runs the steps of a stage that are left, logging each and saving a checkpoint now and then.

        Args:
            count: of steps.
            optimizers: their state is saved, and restored where a stage goes on.
            constants: arrays that the checkpoint keeps; those of optimizers, ``name/...``, are left out.
            variables: further arrays, as they are when a checkpoint is saved.
            stalled: whether the stage ends after so many steps, though some are left.
        """
        first = self.checkpoint.iteration
        if first > 0:
            for name, optimizer in optimizers.items():
                restore_optimizer(name, optimizer, self.checkpoint.arrays)
        constants = {name: constants[name] for name in constants if "/" not in name}

        def save(done: int) -> None:
            arrays = constants | variables()
            for name, optimizer in optimizers.items():
                arrays |= optimizer_arrays(name, optimizer)
            self.checkpoint.iteration, self.checkpoint.arrays = done, arrays
            self.checkpoint.save(self._path)

        with self.progress.stage(stage, count, first) as advance:
            saved, pause = time.monotonic(), self.checkpoint_seconds
            for iteration in range(first, count):
                if stalled(iteration):
                    break
                begin = time.monotonic()
                advance(self._step(stage, iteration, count, worker, iteration))
                self._spent(stage, time.monotonic() - begin)
                if time.monotonic() - saved > pause:
                    begin = time.monotonic()
                    save(iteration + 1)
                    saved = time.monotonic()
                    pause = max(self.checkpoint_seconds, _CHECKPOINT_PAUSE * (saved - begin))
        save(count)

    def repeat(self, stage: str, count: int, worker: Worker, first: int) -> None:
        """Runs all steps of a stage once more, logged as those from ``first`` on; nothing is saved meanwhile,
        so a fit that goes on does them again."""
        with self.progress.stage(f"{stage} again", count) as advance:
            for iteration in range(count):
                advance(self._step(stage, first + iteration, first + count, worker, iteration))

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Counts what is done inside as time of a stage."""
        begin = time.monotonic()
        yield
        self._spent(stage, time.monotonic() - begin)

    def rewind_log(self) -> None:
        """Drops the lines of steps that a killed run did after its last checkpoint: they are done again. So
        are lines that are no steps; a damaged log is no reason to stop."""
        reached = (STAGES.index(self.checkpoint.stage), self.checkpoint.iteration)
        lines = self._log.read_bytes().splitlines(keepends=True) if self._log.exists() else []
        kept = [line for line in lines if (step := _step_of(line)) is not None and step < reached]
        with replacing(self._log) as partial:
            partial.write_bytes(b"".join(kept))

    def _step(self, stage: str, logged: int, count: int, worker: Worker, iteration: int) -> dict[str, float]:
        """One step, which the log and the observer hear of as the step ``logged`` of ``count``."""
        begin = time.monotonic()
        self.interrupt.check()
        values = {name: float(value) for name, value in worker.step(iteration).items()}
        self._write_log(stage, logged, values, time.monotonic() - begin)
        if self.observer:
            self.observer.step(stage, logged, count, values, worker.preview)
        return values

    def _spent(self, stage: str, seconds: float) -> None:
        self.checkpoint.seconds[stage] = round(self.checkpoint.seconds.get(stage, 0.0) + seconds, 3)

    def _write_log(self, stage: str, iteration: int, values: dict[str, float], seconds: float) -> None:
        rounded = {name: float(f"{value:.6g}") for name, value in values.items()}
        with open(self._log, "a") as log:
            log.write(json.dumps({"stage": stage, "iteration": iteration, **rounded,
                                  "seconds": round(seconds, 4)}) + "\n")


def _step_of(line: bytes) -> tuple[int, int] | None:
    """The stage's number and the step in it that a line of the log tells of; None if it is none."""
    if not line.endswith(b"\n"):
        return None
    try:
        step = json.loads(line)
        stage, iteration = STAGES.index(step["stage"]), step["iteration"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return (stage, iteration) if type(iteration) is int else None


def checkpoint_path(output: Path) -> Path:
    """Where the checkpoint of a fit lies in its folder."""
    return output / "checkpoint.npz"
