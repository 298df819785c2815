import threading

from lines import Lines
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

from gshell_mi.bars import Bars


def bars(**options) -> Bars:
    return Bars(TextColumn("converting"), BarColumn(), MofNCompleteColumn(), begun=0.02, **options)


def test_without_a_terminal_what_takes_long_has_lines_though_it_does_not_get_on(capfd):
    with bars(pause=0.1) as progress:
        progress.advance(progress.add_task("", total=100), 7)
        found = Lines(capfd).wait_for(3)
    assert found[:3] == ["converting   7/100"] * 3


def test_a_task_that_has_just_begun_is_told_at_once_and_what_is_done_is_not(capfd):
    lines = Lines(capfd)
    with bars(pause=600.0) as progress:
        progress.add_task("", total=3)
        lines.wait_for(1)
        second = progress.add_task("", total=2, completed=1)
        lines.wait_for(2)
        progress.update(second, completed=2)
        lines.wait_for(3)
    assert lines.read() == ["converting 0/3", "converting 1/2", "converting 0/3"]


def test_quiet(capfd):
    with bars(quiet=True) as progress:
        progress.update(progress.add_task("", total=3), advance=1)
        assert Lines(capfd).wait_for(1, seconds=0.2) == []


def test_each_of_many_is_told_too(capfd):
    lines = Lines(capfd)
    with bars(pause=600.0) as progress:
        for _ in progress.each(range(2), 2):
            lines.wait_for(1)
    assert lines.read() == ["converting 0/2"]


def test_nothing_is_left_running():
    before = threading.active_count()
    with Bars() as progress:
        assert progress.in_lines and threading.active_count() == before + 1
    assert threading.active_count() == before
