"""Phases of an iteration: nothing without a stopwatch, and nothing counted twice with one."""

import time

import drjit as dr
import mitsuba as mi
import pytest

from gshell_mi.timing import Stopwatch, phase


def test_without_a_stopwatch_nothing_is_computed():
    x = mi.Float([1, 2, 3]) * 2
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    dr.kernel_history_clear()
    with phase("work") as compute:
        compute(x + 1)
    assert dr.kernel_history() == []
    dr.set_flag(dr.JitFlag.KernelHistory, False)


def test_with_one_the_phase_computes_what_it_is_given():
    with Stopwatch() as watch:
        dr.set_flag(dr.JitFlag.KernelHistory, True)
        dr.kernel_history_clear()
        with phase("work") as compute:
            compute(mi.Float([1, 2, 3]) + mi.Float([5, 6, 7]))
        assert len(dr.kernel_history()) == 1
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    assert set(watch.seconds) == {"work"}


def test_inner_phases_are_taken_out_of_outer_ones():
    clock = iter(range(100))
    with Stopwatch(clock=lambda: next(clock)) as watch:
        with phase("outer"):  # begins at 0
            with phase("inner"):  # 1 to 2
                pass
            with phase("inner"):  # 3 to 4
                pass
        # ends at 5
    assert watch.seconds == {"outer": 3, "inner": 2}


def test_seconds_add_up():
    with Stopwatch() as watch:
        begin = time.perf_counter()
        for _ in range(2):
            with phase("a"):
                time.sleep(0.02)
            with phase("b"):
                time.sleep(0.01)
        total = time.perf_counter() - begin
    assert watch.seconds["a"] >= 0.04 and watch.seconds["b"] >= 0.02
    assert sum(watch.seconds.values()) == pytest.approx(total, abs=0.02)


def test_a_stopwatch_stops():
    with Stopwatch() as watch:
        pass
    with phase("later"):
        pass
    assert not watch.seconds
