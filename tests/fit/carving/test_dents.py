"""Dents that nobody sees are filled in; those that there are stay."""

import mitsuba as mi
import numpy as np
import pytest
from cup import HALF, cup, fit_of, solid_block, surface_of

from gshell_mi.fit.carving.dents import dents, without_dents

RESOLUTION = 32
CELL = 2 / RESOLUTION

#: Half the width of a shaft, and how high its bottom is.
WIDTH, FLOOR = 0.15, 0.2


@pytest.fixture(scope="module")
def subject():
    return mi.load_dict({"type": "gshell", "resolution": RESOLUTION})


@pytest.fixture
def shaft(subject):
    """A block with a shaft in its upper side."""
    points = subject.lattice.points(mi.Float).numpy().T
    within = np.maximum(np.abs(points[:, [0, 2]]).max(axis=1) - WIDTH, FLOOR - points[:, 1])
    sdf = np.maximum(np.abs(points).max(axis=1) - HALF, -within)
    return surface_of(sdf, np.ones_like(sdf))


def lowest(fit, surface):
    """Where a ray from above into the shaft ends."""
    vertices = fit.mesh(surface)[0]
    return vertices[(np.abs(vertices[:, [0, 2]]) < WIDTH / 2).all(axis=1) & (vertices[:, 1] > 0), 1].mean()


@pytest.mark.parametrize("blocks", [False, True])
def test_a_shaft_that_is_none_is_filled_in(subject, shaft, blocks):
    fit = fit_of(subject, solid_block())
    assert lowest(fit, shaft) == pytest.approx(FLOOR, abs=0.5 * CELL)
    found, verdict = without_dents(fit, shaft.in_blocks() if blocks else shaft)
    assert (found.fields.blocks is not None) == blocks
    assert lowest(fit, found) == pytest.approx(HALF, abs=1.5 * CELL)  # a ball dips into it
    assert verdict.accepted[0]
    beside = (shaft.lattice.points(mi.Float).y.numpy() < 0) & (np.abs(shaft.fields.sdf) < CELL)
    np.testing.assert_array_equal(found.whole().fields.sdf[beside], shaft.fields.sdf[beside])


def test_a_shaft_that_is_there_stays(subject, shaft):
    found, verdict = without_dents(fit_of(subject, cup(FLOOR, HALF - WIDTH)), shaft)
    assert found is shaft and (verdict.gain < 0).all() and np.isfinite(verdict.noise).all()


def test_a_block_has_none(subject):
    sdf = np.abs(subject.lattice.points(mi.Float).numpy()).max(axis=0) - HALF
    block = surface_of(sdf, np.ones_like(sdf))
    assert without_dents(fit_of(subject, solid_block()), block) == (block, None)


def test_dents_are_narrower_than_the_ball_and_apart():
    distance = np.full((20, 60, 40), 4.0)
    distance[:8] = -4
    for column, half in ((12, 3), (40, 8)):
        distance[4:8, column - half : column + half, 10:30] = 4
    narrow, wide = (4, 12, 20), (4, 40, 20)
    found, more = dents(distance, 4.0), dents(distance, 20.0)
    assert found[narrow] and not found[wide]
    assert more[narrow] and more[wide]
