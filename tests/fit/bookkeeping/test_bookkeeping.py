"""Steps that are done once more are logged and watched like the others, and forgotten with a kill."""

import json

import pytest

from gshell_mi.fit.bookkeeping.bookkeeping import Bookkeeping
from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint
from gshell_mi.fit.bookkeeping.progress import Progress
from gshell_mi.interrupt import Interrupt

COUNT = 3


class Counter:
    """A worker that says which step it does."""

    def step(self, iteration):
        return {"loss": 10 + iteration}

    def preview(self):
        raise AssertionError("nobody looks")


class Watcher:
    """An observer that keeps what it is told."""

    def __init__(self):
        self.told = []

    def step(self, stage, iteration, count, values, preview):
        self.told.append((stage, iteration, count, values["loss"]))


@pytest.fixture
def logged(tmp_path):
    """A ghost stage whose steps were done twice: its books, and what reads the log."""
    watcher = Watcher()
    with Interrupt() as interrupt, Progress(quiet=True) as progress:
        books = Bookkeeping(tmp_path, Checkpoint("ghost", 0, {}), 1e9, progress, interrupt, watcher)
        books.iterate("ghost", COUNT, Counter(), {}, {})
        books.repeat("ghost", COUNT, Counter(), first=COUNT)
    return books, watcher, lambda: [json.loads(line) for line in open(tmp_path / "log.jsonl")]


def test_steps_done_again_go_on_in_the_log_and_for_the_observer(logged):
    _, watcher, log = logged
    assert [(line["iteration"], line["loss"]) for line in log()] == [
        (0, 10), (1, 11), (2, 12), (3, 10), (4, 11), (5, 12)]
    assert watcher.told[COUNT:] == [("ghost", 3, 6, 10), ("ghost", 4, 6, 11), ("ghost", 5, 6, 12)]


def test_a_fit_that_goes_on_does_them_again(logged):
    books, _, log = logged
    assert books.checkpoint.iteration == COUNT, "nothing was saved meanwhile"
    books.rewind_log()
    assert [line["iteration"] for line in log()] == [0, 1, 2]
