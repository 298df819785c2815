import threading
import time

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

from gshell_mi.bars import Bars


def lines(capfd, work, **options):
    columns = (TextColumn("converting"), BarColumn(), MofNCompleteColumn())
    with Bars(*columns, begun=0.05, **options) as progress:
        work(progress)
    return capfd.readouterr().err.splitlines()


def test_without_a_terminal_what_takes_long_has_lines_though_it_does_not_get_on(capfd):
    def work(progress):
        task = progress.add_task("", total=100)
        progress.advance(task, 7)
        time.sleep(1.0)

    found = lines(capfd, work, pause=0.3)
    assert set(found) == {"converting   7/100"} and 2 <= len(found) <= 4


def test_a_task_that_has_just_begun_is_told_at_once_and_what_is_done_is_not(capfd):
    def work(progress):
        progress.add_task("", total=3)
        time.sleep(0.2)
        second = progress.add_task("", total=2)
        progress.update(second, completed=1)
        time.sleep(0.2)
        progress.update(second, completed=2)
        time.sleep(0.2)

    assert lines(capfd, work, pause=60.0) == ["converting 0/3", "converting 1/2", "converting 0/3"]


def test_quiet(capfd):
    def work(progress):
        progress.update(progress.add_task("", total=3), advance=1)
        time.sleep(0.2)

    assert lines(capfd, work, quiet=True) == []


def test_each_of_many_is_told_too(capfd):
    def work(progress):
        for _ in progress.each(range(2), 2):
            time.sleep(0.2)

    assert lines(capfd, work, pause=60.0) == ["converting 0/2"]


def test_nothing_is_left_running(capfd):
    before = threading.active_count()
    with Bars():
        assert threading.active_count() == before + 1
    assert threading.active_count() == before
