"""Runs stages one after another: checkpoints, log, seconds, progress, and how a fit goes on."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..files import replacing
from ..interrupt import Interrupt
from ..optimizer_arrays import optimizer_arrays, restore_optimizer
from ..progress import Progress
from .bookkeeping.checkpoint import DONE, Checkpoint
from .bookkeeping.observer import Observer
from .stage import Fit, Stage, Work
from .surface import Surface
from .template import preview_of

#: Between two checkpoints at least this many times what writing one takes.
_CHECKPOINT_PAUSE = 10

#: Names of what a running stage keeps in the checkpoint, beside the surface that it was given.
_WORK = "work/"


class Runner:
    """Runs the stages of a fit, and writes down where it is.

    Args:
        output: the fit's folder, which ``checkpoint.npz`` and ``log.jsonl`` are written to.
        checkpoint: where the fit stands; kept up to date.
        checkpoint_seconds: least time between two checkpoints within a stage.
        progress: shows the stages.
        interrupt: ends the run between two steps.
        observer: is told of every step.
    """

    def __init__(
        self,
        output: Path,
        checkpoint: Checkpoint,
        checkpoint_seconds: float,
        progress: Progress,
        interrupt: Interrupt,
        observer: Observer | None,
    ):
        self.checkpoint, self.checkpoint_seconds = checkpoint, checkpoint_seconds
        self.progress, self.interrupt, self.observer = progress, interrupt, observer
        self.output, self._path, self._log = output, checkpoint_path(output), output / "log.jsonl"

    def run(self, stages: Sequence[Stage], fit: Fit, surface: Surface) -> Surface:
        """Runs the stages that are left.

        Args:
            stages: all of them, in their order.
            fit: what they may read; of targets and cameras, those that come out of it once the exposures and
                the poses are known.
            surface: what the first one begins with.

        Returns:
            What the last one has made of it.
        """
        checkpoint, names = self.checkpoint, [stage.name for stage in stages] + [DONE]
        if checkpoint.arrays:
            surface = Surface.from_arrays(checkpoint.arrays)
        elif not checkpoint.stage:
            checkpoint.stage = names[0]
        if checkpoint.stage not in names:
            raise UserError(
                f"The checkpoint '{self._path}' is in the stage '{checkpoint.stage}', which this "
                f"fit has not; start without --resume."
            )
        self._rewind_log(names)
        seen, told = fit, Surface(surface.fields)
        for stage, following in zip(stages, names[1:], strict=True):
            if stage.name == checkpoint.stage:
                if not surface.tells_the_same(told):
                    seen, told = fit.corrected(surface), surface
                surface = stage.run(seen, surface, Steps(self, stage.name, surface)).after(surface)
                checkpoint.stage, checkpoint.iteration, checkpoint.arrays = following, 0, surface.to_arrays()
                self.save()
                if self.observer:
                    self.observer.stage_done(stage.name, partial(preview_of, seen, surface))
                # Sizes that this stage needed are not those of the next.
                dr.flush_malloc_cache()
        return surface

    def save(self) -> None:
        """Writes the checkpoint."""
        self.checkpoint.save(self._path)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Counts what is done inside as time of a stage."""
        begin = time.monotonic()
        yield
        spent = self.checkpoint.seconds.get(stage, 0.0) + time.monotonic() - begin
        self.checkpoint.seconds[stage] = round(spent, 3)

    def step(self, stage: str, logged: int, count: int, work: Work, iteration: int) -> dict[str, float]:
        """One step, which the log and the observer hear of as the step ``logged`` of ``count``."""
        begin = time.monotonic()
        self.interrupt.check()
        values = {name: float(value) for name, value in work.step(iteration).items()}
        rounded = {name: float(f"{value:.6g}") for name, value in values.items()}
        with open(self._log, "a") as log:
            log.write(
                json.dumps(
                    {
                        "stage": stage,
                        "iteration": logged,
                        **rounded,
                        "seconds": round(time.monotonic() - begin, 4),
                    }
                )
                + "\n"
            )
        if self.observer:
            self.observer.step(stage, logged, count, values, work.preview)
        return values

    def _rewind_log(self, names: list[str]) -> None:
        """Drops the lines of steps that a killed run did after its last checkpoint: they are done again. So
        are lines that are no steps; a damaged log is no reason to stop."""
        if not self._log.exists():
            return
        reached = (names.index(self.checkpoint.stage), self.checkpoint.iteration)
        lines = self._log.read_bytes().splitlines(keepends=True)
        kept = [line for line in lines if (step := _step_of(line, names)) is not None and step < reached]
        with replacing(self._log) as partial:
            partial.write_bytes(b"".join(kept))


class Steps:
    """What a stage may ask of the runner.

    Args:
        runner: whose checkpoint is in that stage.
        stage: its name.
        surface: that it is given.

    Attributes:
        done: steps that a run before has done; 0 of a stage that begins.
        kept: what ``state`` gave then; empty of a stage that begins.
    """

    def __init__(self, runner: Runner, stage: str, surface: Surface):
        self._runner, self._stage, self._surface = runner, stage, surface
        self.done = runner.checkpoint.iteration
        self.kept = runner.checkpoint.part(_WORK)

    def run(
        self,
        work: Work,
        count: int,
        optimizers: Mapping[str, mi.ad.Adam],
        state: Callable[[], dict[str, np.ndarray]] = dict,
        stalled: Callable[[int], bool] = lambda done: False,
        surface: Surface | None = None,
    ) -> None:
        """Does the steps that are left, once per stage. Each is logged, and now and then all is saved.

        Args:
            work: does them.
            count: of steps.
            optimizers: by name; they are saved, and restored where a stage goes on.
            state: what else to keep for a run that goes on.
            stalled: whether the stage ends after so many steps, though some are left.
            surface: that a stage which goes on is given, if another one than this stage was given.
        """
        runner, stage, first = self._runner, self._stage, self.done
        if first > 0:
            for name, optimizer in optimizers.items():
                restore_optimizer(name, optimizer, self.kept)
        given = (surface or self._surface).to_arrays()

        def save(done: int) -> None:
            arrays = state()
            for name, optimizer in optimizers.items():
                arrays |= optimizer_arrays(name, optimizer)
            runner.checkpoint.iteration = done
            runner.checkpoint.arrays = given | {_WORK + name: array for name, array in arrays.items()}
            runner.save()

        with runner.progress.stage(stage, count, first) as advance:
            saved, pause = time.monotonic(), runner.checkpoint_seconds
            for iteration in range(first, count):
                if stalled(iteration):
                    break
                with runner.timed(stage):
                    advance(runner.step(stage, iteration, count, work, iteration))
                if time.monotonic() - saved > pause:
                    begin = time.monotonic()
                    save(iteration + 1)
                    saved = time.monotonic()
                    pause = max(runner.checkpoint_seconds, _CHECKPOINT_PAUSE * (saved - begin))
        save(count)

    def repeat(self, work: Work, count: int, first: int) -> None:
        """Does all steps once more, logged as those from ``first`` on; a run that goes on does them again."""
        with self._runner.progress.stage(f"{self._stage} again", count) as advance:
            for iteration in range(count):
                advance(self._runner.step(self._stage, first + iteration, first + count, work, iteration))

    @contextmanager
    def task(self, name: str = "", total: int | None = None) -> Iterator[Callable[[], None]]:
        """What is done inside has a line of its own, and counts as time of the stage.

        Args:
            name: what to call it, after the stage's name.
            total: how often the function is called that the context gives.
        """
        shown = f"{self._stage} {name}".strip()
        with self._runner.progress.stage(shown, total) as advance, self._runner.timed(self._stage):
            yield advance

    def fact(self, name: str, value: Any) -> None:
        """Something for the metrics; of a JSON type."""
        self._runner.checkpoint.facts[name] = value


def _step_of(line: bytes, names: list[str]) -> tuple[int, int] | None:
    """The stage's number and the step in it that a line of the log tells of; None if it is none."""
    if not line.endswith(b"\n"):
        return None
    try:
        step = json.loads(line)
        stage, iteration = names.index(step["stage"]), step["iteration"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return (stage, iteration) if type(iteration) is int else None


def checkpoint_path(output: Path) -> Path:
    """Where the checkpoint of a fit lies in its folder."""
    return output / "checkpoint.npz"
