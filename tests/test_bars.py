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


def test_each_of_many_is_told_too(monkeypatch, capfd):
    def work(progress, now):
        for _ in progress.each(range(50), 50):
            now[0] += 2.0

    found = lines(monkeypatch, capfd, work)
    assert [line[:17] for line in found] == [f"converting {count:>2}/50 " for count in (1, 16, 31, 46)]
