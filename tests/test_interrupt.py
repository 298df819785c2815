import contextlib
import signal
import threading

import pytest

from gshell_mi.interrupt import Interrupt, interrupts_held_back


@pytest.fixture(autouse=True)
def default_handler():
    """A shell starts background jobs with Ctrl-C ignored, and tests may run in one."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_swallowed_interrupt_comes_back():
    with Interrupt() as interrupt:
        interrupt.check()
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            interrupt.check()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_it_is_raised_at_once():
    with Interrupt(), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_another_handler_is_left_alone():
    calls = []

    def own(*_):
        calls.append(1)

    signal.signal(signal.SIGINT, own)
    with Interrupt() as interrupt:
        signal.raise_signal(signal.SIGINT)
        interrupt.check()
    assert calls == [1] and signal.getsignal(signal.SIGINT) is own


def test_in_a_thread_it_does_nothing():
    done = []

    def work():
        with Interrupt() as interrupt:
            interrupt.check()
        done.append(1)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done


def test_work_that_is_held_together_ends_before_the_interrupt():
    steps = []
    with Interrupt() as interrupt, pytest.raises(KeyboardInterrupt):
        with interrupts_held_back():
            signal.raise_signal(signal.SIGINT)
            steps.append("rest")
        steps.append("after")
    assert steps == ["rest"] and interrupt.pending
    assert signal.getsignal(signal.SIGINT) is not None
