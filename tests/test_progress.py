import re

import pytest

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


def test_without_a_terminal_a_stage_says_where_it_is(monkeypatch: pytest.MonkeyPatch, capfd):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    with Progress() as progress, progress.stage("joint", 100) as advance:
        for _ in range(50):
            now[0] += 1.0
            advance({"loss": 0.5, "psnr": 20.0})
    lines = capfd.readouterr().err.splitlines()
    assert lines == [
        "joint: loss 0.5000  PSNR 20.0 dB  1/100",
        "joint: loss 0.5000  PSNR 20.0 dB  31/100  1.00 s/step  1:09 left",
        "joint: took 50.0 s",
    ]


def test_without_a_terminal_rendering_of_targets_is_told_too(monkeypatch: pytest.MonkeyPatch, capfd):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    with Progress() as progress, progress.stage("targets", None):
        for done in range(48):
            now[0] += 20.0
            progress.reference(done + 1, 48)
    lines = capfd.readouterr().err.splitlines()
    assert lines[:3] == [f"targets: {done}/48 rendered" for done in (1, 3, 5)] and len(lines) == 25


def test_a_quiet_warning_is_one_of_python():
    progress = Progress(quiet=True)
    with pytest.warns(UserWarning, match="no alpha"):
        progress.warn("no alpha")
    assert progress.warnings == ["no alpha"]
