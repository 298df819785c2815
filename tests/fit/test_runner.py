"""The runner: stages one after another, steps that are done again, and fits that go on."""

import json
from dataclasses import replace

import numpy as np
import pytest

from gshell_mi.errors import UserError
from gshell_mi.fields import sphere
from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint
from gshell_mi.fit.runner import Runner, checkpoint_path
from gshell_mi.fit.surface import Moved, Seen, Surface
from gshell_mi.interrupt import Interrupt
from gshell_mi.lattice import TetLattice
from gshell_mi.progress import Progress

COUNT = 3
START = Surface(sphere(TetLattice(4)))


class Counter:
    """Work that says which step it does, and ends a fit before one of them."""

    def __init__(self, ends_before: int | None = None):
        self.ends_before = ends_before

    def step(self, iteration):
        if iteration == self.ends_before:
            raise KeyboardInterrupt
        return {"loss": 10 + iteration}

    def preview(self):
        raise AssertionError("nobody looks")


class Rises:
    """A stage of three steps, done once more if asked, that adds 1 to the mSDF."""

    def __init__(self, name: str, *, again: bool = False, ends_before: int | None = None):
        self.name, self.again, self.work = name, again, Counter(ends_before)

    def run(self, fit, surface, steps):
        self.done, self.kept = steps.done, dict(steps.kept)
        steps.run(self.work, COUNT, {}, lambda: {"half way": np.array(7)})
        if self.again:
            steps.repeat(self.work, COUNT, first=COUNT)
        with steps.task("verdict"):
            steps.fact(f"{self.name}_kept", True)
        return surface.with_fields(msdf=surface.fields.msdf + 1)


class Watcher:
    """An observer that keeps what it is told."""

    def __init__(self):
        self.told, self.done = [], []

    def step(self, stage, iteration, count, values, preview):
        self.told.append((stage, iteration, count, values["loss"]))

    def stage_done(self, stage, preview):
        self.done.append(stage)


def run(folder, stages, checkpoint=None, watcher=None) -> tuple[Surface, Checkpoint]:
    checkpoint = checkpoint or Checkpoint("", 0, {})
    with Interrupt() as interrupt, Progress(quiet=True) as progress:
        runner = Runner(folder, checkpoint, 0.0, progress, interrupt, watcher)
        return runner.run(stages, None, START), checkpoint


def log(folder):
    lines = map(json.loads, (folder / "log.jsonl").read_text().splitlines())
    return [(line["stage"], line["iteration"], line["loss"]) for line in lines]


def test_each_stage_starts_where_the_one_before_has_ended(tmp_path):
    surface, checkpoint = run(tmp_path, [Rises("first"), Rises("second")])
    np.testing.assert_array_equal(surface.fields.msdf, START.fields.msdf + 2)
    assert checkpoint.stage == "done" and checkpoint.facts == {"first_kept": True, "second_kept": True}
    assert set(checkpoint.seconds) == {"first", "second"}
    assert log(tmp_path) == [(stage, i, 10 + i) for stage in ("first", "second") for i in range(COUNT)]


def test_steps_done_again_go_on_in_the_log_and_for_the_observer(tmp_path):
    watcher = Watcher()
    run(tmp_path, [Rises("first", again=True)], watcher=watcher)
    assert log(tmp_path) == [("first", i, 10 + i % COUNT) for i in range(2 * COUNT)]
    assert watcher.told[COUNT:] == [("first", COUNT + i, 2 * COUNT, 10 + i) for i in range(COUNT)]
    assert watcher.done == ["first"]


def test_a_fit_goes_on_where_it_was_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr("gshell_mi.fit.runner._CHECKPOINT_PAUSE", 0)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, [Rises("first"), Rises("second", ends_before=2)])
    with open(tmp_path / "log.jsonl", "a") as file:
        file.write('{"stage": "second", "iteration": 2, "loss": 12}\n{"stage": "tea"}\nnonsense')
    stages = [Rises("first", ends_before=0), Rises("second")]
    surface, _ = run(tmp_path, stages, Checkpoint.load(checkpoint_path(tmp_path)))
    assert stages[1].done == 2 and stages[1].kept == {"half way": 7}
    np.testing.assert_array_equal(surface.fields.msdf, START.fields.msdf + 2)
    assert log(tmp_path) == [(stage, i, 10 + i) for stage in ("first", "second") for i in range(COUNT)]


def test_steps_that_are_done_again_are_forgotten_with_a_kill(tmp_path):
    class Killed(Counter):
        def step(self, iteration):
            self.count = getattr(self, "count", 0) + 1
            if self.count == COUNT + 2:
                raise KeyboardInterrupt
            return super().step(iteration)

    stage = Rises("first", again=True)
    stage.work = Killed()
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, [stage])
    assert len(log(tmp_path)) == COUNT + 1
    stage = Rises("first", again=True)
    run(tmp_path, [stage], Checkpoint.load(checkpoint_path(tmp_path)))
    assert stage.done == COUNT
    assert log(tmp_path) == [("first", i, 10 + i % COUNT) for i in range(2 * COUNT)]


def test_a_fit_that_is_done_does_nothing(tmp_path):
    whole, _ = run(tmp_path, [Rises("first")])
    again, _ = run(tmp_path, [Rises("first", ends_before=0)], Checkpoint.load(checkpoint_path(tmp_path)))
    np.testing.assert_array_equal(again.fields.msdf, whole.fields.msdf)


def test_a_checkpoint_in_a_stage_that_there_is_not(tmp_path):
    run(tmp_path, [Rises("first")])
    checkpoint = replace(Checkpoint.load(checkpoint_path(tmp_path)), stage="appearance")
    with pytest.raises(UserError, match="is in the stage 'appearance', which this fit has not"):
        run(tmp_path, [Rises("first")], checkpoint)


def test_a_surface_is_what_its_arrays_say(tmp_path):
    count = START.lattice.vertex_count
    moved = [
        Moved(name, np.ones((5, 3)), np.zeros((5, 3)), {"radiance/opacity/value": np.ones(3)})
        for name in ("folds", "refinement")
    ]
    seen = Seen(np.ones((count, 3)), np.ones(count, bool), np.float32(2))
    whole = replace(
        START,
        hull=np.arange(count),
        seen=seen,
        moved=tuple(moved),
        model={"log_radiance": np.ones((2, 4, 3))},
        settled=True,
        gains=np.full((3, 3), 1.1),
    )
    checkpoint = Checkpoint("joint", 0, {}, whole.to_arrays())
    checkpoint.save(tmp_path / "checkpoint.npz")
    found = Surface.from_arrays(Checkpoint.load(tmp_path / "checkpoint.npz").arrays)
    assert found.lattice == whole.lattice and found.settled and found.seen.light == 2
    assert [one.stage for one in found.moved] == ["folds", "refinement"]
    assert found.to_arrays().keys() == whole.to_arrays().keys()
    for name, array in found.to_arrays().items():
        np.testing.assert_array_equal(array, whole.to_arrays()[name])
    bare = Surface.from_arrays(START.to_arrays())
    assert bare.hull is None and bare.seen is None and not bare.moved and not bare.model
    assert bare.gains is None
