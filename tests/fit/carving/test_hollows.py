"""The minimum cut on volumes that are known: a ball with a slot, a shell that is open at the top."""

import numpy as np
import pytest

from gshell_mi.fit.carving.hollows import hollows

N = 32
AXIS = np.arange(N + 1) - N / 2
Z, Y, X = np.meshgrid(AXIS, AXIS, AXIS, indexing="ij")
RADIUS = 11.0
HULL = np.sqrt(X**2 + Y**2 + Z**2) - RADIUS
CLOSED = np.ones_like(HULL)


def volume(solid, seen):
    """Opaque where solid; seen as given, and a cell deep into the opaque."""
    return 0.97 * solid, seen


def slot(depth):
    return (np.abs(X) < 2.5) & (np.abs(Z) < 5.5) & (Y > RADIUS - depth)


@pytest.mark.parametrize("depth", [6, 12])
def test_a_slot_is_hollowed_out(depth):
    air = slot(depth)
    opacity, seen = volume((HULL < 0) & ~air, (HULL >= 0) | air)
    distance = hollows(HULL, CLOSED, opacity, seen)
    # Along the slot's middle the sign changes between its last solid vertex and its first empty one.
    last = int(RADIUS - depth + N / 2)
    below, above = distance[N // 2, last : last + 2, N // 2]
    assert below < 0 < above and below == pytest.approx(-above, abs=0.1)
    hollow = (distance > 0) & (HULL < 0)
    assert (hollow & air).sum() > 0.85 * (air & (HULL < 0)).sum()
    assert not (hollow & ~air & (HULL < -1)).any()


def test_a_solid_has_none():
    opacity, seen = volume(HULL < 0, HULL >= 0)
    assert hollows(HULL, CLOSED, opacity, seen) is None


def test_something_has_to_be_left():
    opacity, seen = volume(np.zeros_like(HULL), np.ones_like(HULL, bool))
    assert hollows(HULL, CLOSED, opacity, seen) is None


def test_shallow_ones_are_left_alone():
    air = slot(1.5)
    opacity, seen = volume((HULL < 0) & ~air, (HULL >= 0) | air)
    assert hollows(HULL, CLOSED, opacity, seen) is None


def test_the_inside_behind_an_opening_is_no_hollow():
    """A thin shell whose top is open: all of its inside is in sight, and stays inside of the template."""
    shell = (HULL < 0) & (HULL > -2.2) & (Y < 7)
    opacity, seen = volume(shell, ~shell)
    top = np.where(Y > 7, -1.0, 1.0)
    assert hollows(HULL, top, opacity, seen) is None
    closed = hollows(HULL, CLOSED, opacity, seen)
    assert closed[N // 2, N // 2, N // 2] > 3, "without the opening it would be outside"


def test_a_leak_does_not_drain_the_inside():
    shell = (HULL < 0) & (HULL > -2.2) & (Y < 7)
    shell &= ~((np.abs(X) < 1.5) & (np.abs(Y) < 1.5) & (Z > 0))
    opacity, seen = volume(shell, ~shell)
    distance = hollows(HULL, np.where(Y > 7, -1.0, 1.0), opacity, seen)
    assert distance is None or (distance > 0).sum() < 100
