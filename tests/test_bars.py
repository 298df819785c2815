from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from gshell_mi import bars as module
from gshell_mi.bars import Bars


def lines(monkeypatch, capfd, work, **options):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    columns = (TextColumn("converting"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bars(*columns, **options) as progress:
        progress.get_time = lambda: now[0]
        work(progress, now)
    return capfd.readouterr().err.splitlines()


def test_without_a_terminal_a_line_every_half_a_minute(monkeypatch, capfd):
    def work(progress, now):
        task = progress.add_task("", total=100)
        for _ in range(50):
            now[0] += 2.0
            progress.advance(task)
        progress.update(task, total=200)

    found = lines(monkeypatch, capfd, work)
    assert found == [
        "converting   1/100 -:--:--",
        "converting  16/100 0:02:48",
        "converting  31/100 0:02:18",
        "converting  46/100 0:01:48",
    ]


def test_quiet(monkeypatch, capfd):
    def work(progress, now):
        progress.update(progress.add_task("", total=3), advance=1)

    assert lines(monkeypatch, capfd, work, quiet=True) == []


def test_what_is_tracked_is_told_too(monkeypatch, capfd):
    assert lines(monkeypatch, capfd, lambda progress, now: list(progress.track(range(3), total=3)))
