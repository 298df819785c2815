"""A block that is a cup in truth takes its hollow from another surface, and not the crater below it."""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from cup import HALF, WALL, cup, fit_of, hull_of, surface_of

from gshell_mi.fit.judge import Judge, Verdict
from gshell_mi.fit.volume.merging import merged

RESOLUTION = 32
CELL = 2 / RESOLUTION
AXIS = np.linspace(-1, 1, RESOLUTION + 1)
Z, Y, X = np.meshgrid(AXIS, AXIS, AXIS, indexing="ij")

BLOCK, _, _ = hull_of(RESOLUTION)

#: Positive in the cup's hollow, and in a crater in the bottom, which no view sees.
HOLLOW = np.minimum(HALF - WALL - np.maximum(abs(X), abs(Z)), Y)
CRATER = 0.3 - np.sqrt(X**2 + (Y + HALF) ** 2 + Z**2)


@pytest.fixture(scope="module")
def fit():
    return fit_of(mi.load_dict({"type": "gshell", "resolution": RESOLUTION}), cup())


def of(*hollows: np.ndarray, opened: np.ndarray | None = None):
    return surface_of(np.maximum.reduce([BLOCK, *hollows]), np.ones_like(BLOCK) if opened is None else opened)


def test_what_is_true_is_taken_and_what_is_not_is_left(fit):
    found = merged(fit, of(), of(HOLLOW, CRATER))
    assert (found.taken, found.places) == (1, 2) and found.whole.accepted[0]
    sdf = found.surface.fields.sdf.reshape(BLOCK.shape)
    centre, quarter = RESOLUTION // 2, round(0.25 / CELL)
    assert sdf[centre, centre + quarter, centre] > 0 > sdf[centre, centre - 2 * quarter, centre]
    assert found.surface.seen.known.any() and found.surface.seen.radiance.max() > 0.1


def test_openings_elsewhere_stay_if_every_place_is_taken(fit):
    """Elsewhere the other one is worse: it is closed there."""
    surfaces = of(opened=np.where(X < -HALF + CELL, -CELL, CELL)), of(HOLLOW)
    found = merged(SimpleNamespace(**vars(fit) | {"judge": Scripted(fit.judge, [1, -1])}), *surfaces)
    assert (found.taken, found.places) == (1, 1)
    sdf, msdf = (values.reshape(X.shape) for values in (found.surface.fields.sdf, found.surface.fields.msdf))
    assert (msdf[(X < -HALF + 0.5 * CELL) & (abs(sdf) < CELL)] < 0).all()


class Scripted:
    """A judge that has made up its mind: of places by a list, and for whatever comes out."""

    def __init__(self, judge: Judge, gains: list[float]):
        self.shown, self.gains = judge.shown, np.array(gains, float)

    def compare(self, before, after, label=None, where=None, places=1) -> Verdict:
        gains = np.ones(1) if label is None else self.gains
        return Verdict(np.ones_like(gains), np.ones_like(gains), gains, np.full_like(gains, 0.1))


@pytest.mark.parametrize("start", [0, 1])
def test_a_surface_starts_from_the_one_that_is_better_elsewhere(fit, start):
    """And takes from the other one what is better there; what is open elsewhere stays so."""
    surfaces = of(opened=np.where(X < -HALF + CELL, -CELL, CELL)), of(HOLLOW, CRATER)
    hollow, crater, elsewhere = (1, -1, -1) if start == 0 else (-1, 1, 1)
    scripted = SimpleNamespace(**vars(fit) | {"judge": Scripted(fit.judge, [hollow, crater, elsewhere])})
    found = merged(scripted, *surfaces)
    assert (found.taken, found.places) == (1, 2)
    sdf, msdf = (values.reshape(X.shape) for values in (found.surface.fields.sdf, found.surface.fields.msdf))
    centre, quarter = RESOLUTION // 2, round(0.25 / CELL)
    assert (sdf[centre, centre + quarter, centre] > 0) == (hollow > 0)
    assert (sdf[centre, centre - 2 * quarter, centre] > 0) == (crater > 0)
    side = (X < -HALF + 0.5 * CELL) & (abs(sdf) < CELL)
    assert ((msdf[side] < 0) == (start == 0)).all()


def test_what_does_not_help_is_left(fit):
    found = merged(fit, of(), of(CRATER))
    assert found.surface is None and (found.taken, found.places) == (0, 1)


def test_small_differences_alone_may_tell(fit):
    """A block that is a cell too small, and one that is not; no place is apart by more than that."""
    small = surface_of(BLOCK + CELL, np.ones_like(BLOCK))
    assert merged(fit, of(), small).places == merged(fit, small, of()).places == 0
    assert merged(fit, of(), small).surface is None
    other = of()
    assert merged(fit, small, other).surface is other
