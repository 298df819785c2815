import io
import re
from functools import partial

import pytest
from lines import Lines
from rich.console import Console

from gshell_mi import progress as module
from gshell_mi.progress import Progress, usual_duration


def test_the_longest_step_does_not_count():
    assert usual_duration([30.0, 1.0, 2.0, 3.0]) == 2.0
    assert usual_duration([2.0, 2.0]) == 2.0


def test_time_left_after_a_first_step_that_compiles(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    progress = Progress(quiet=True)

    def detail() -> str:
        return progress._bars.tasks[-1].fields["detail"]

    with progress.stage("joint", 100) as advance:
        now[0] += 60
        advance({"loss": 0.5, "psnr": 20.0})
        assert detail() == "loss 0.5000  PSNR 20.0 dB  1/100"
        for _ in range(9):
            now[0] += 0.5
            advance()
        assert re.fullmatch(r"10/100  0\.50 s/step  0:45 left", detail())
    assert detail() == "64.5 s"


def test_a_stage_is_one_line_of_a_narrow_terminal():
    progress = Progress(quiet=True)
    with progress.stage("openings verdict", 100) as advance:
        for _ in range(3):
            advance({"loss": 0.5, "psnr": 20.0})
        console = Console(width=60, file=io.StringIO())
        console.print(progress._bars.make_tasks_table(progress._bars.tasks))
    assert len(console.file.getvalue().splitlines()) == 1


def in_lines(monkeypatch: pytest.MonkeyPatch) -> Progress:
    """Whose lines come every tenth of a second."""
    monkeypatch.setattr(module, "Bars", partial(module.Bars, begun=0.02, pause=0.1))
    return Progress()


def test_without_a_terminal_a_stage_says_where_it_is(monkeypatch: pytest.MonkeyPatch, capfd):
    lines = Lines(capfd)
    with in_lines(monkeypatch) as progress, progress.stage("joint", 100) as advance:
        before = len(lines.wait_for(1))
        advance({"loss": 0.5, "psnr": 20.0})
        lines.wait_for(before + 2)
    first, *told, last = lines.read()
    assert first == "joint: 0:00 so far" and told[-1] == "joint: loss 0.5000  PSNR 20.0 dB  1/100"
    assert re.fullmatch(r"joint: took \d+\.\d s", last)


def test_rendering_of_targets_is_told_by_the_stage_that_it_is_in(monkeypatch: pytest.MonkeyPatch, capfd):
    lines = Lines(capfd)
    with in_lines(monkeypatch) as progress, progress.stage("targets", None):
        progress.reference(3, 48)
        assert lines.wait_for(1)[0] == "targets: 3/48 rendered"
        assert [task.description for task in progress._bars.tasks] == ["targets"]
    assert lines.read()[-1].startswith("targets: took")


def test_a_quiet_warning_is_one_of_python():
    progress = Progress(quiet=True)
    with pytest.warns(UserWarning, match="no alpha"):
        progress.warn("no alpha")
    assert progress.warnings == ["no alpha"]
