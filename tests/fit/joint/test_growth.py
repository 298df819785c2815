"""Openings grow along a template without meeting each other."""

from dataclasses import replace

import numpy as np
import pytest
from cap import cap

from gshell_mi.fields.smoothing import MeshDiffusion
from gshell_mi.fit.joint.residuals import Residuals, near_openings
from gshell_mi.template.growth import grown, joined
from gshell_mi.topology import topology
from gshell_mi.triangles import positive_part

RADIUS = 0.6


def loops(ball, opened) -> tuple[int, int]:
    found = topology(*positive_part(ball.vertices, ball.faces, np.where(opened, -1.0, 1.0)))
    return found.boundary_loops, found.components


# --- growing


def test_an_opening_grows_to_where_it_may(ball):
    up, allowed = cap(ball, [0, 0, 1], 0.1), cap(ball, [0, 0, 1], 0.4)
    np.testing.assert_array_equal(grown(up, allowed, ball.vertices[:, 0], ball.faces), allowed)


def test_openings_that_grow_do_not_meet(ball):
    """Wherever else they may go, a strip stays between them, so there are two loops for ever."""
    start = cap(ball, [0, 0, 1], 0.1) | cap(ball, [1, 0, 0], 0.1)
    allowed = ~cap(ball, [0, 0, -1], 0.3)
    assert loops(ball, allowed) == (1, 1)
    result = grown(start, allowed, ball.vertices[:, 1], ball.faces)
    assert loops(ball, result) == loops(ball, start) == (2, 1)
    assert (allowed & ~result).sum() < 0.05 * len(result)


def test_what_an_opening_surrounds_is_not_cut_off(ball):
    """It may grow around the equator, but not all around."""
    start = cap(ball, [1, 0, 0], 0.02)
    allowed = start | (np.abs(ball.vertices[:, 2]) < 0.15)
    assert loops(ball, allowed) == (2, 2)
    result = grown(start, allowed, np.zeros(len(start)), ball.faces)
    assert loops(ball, result) == (1, 1)
    assert result.sum() > 0.9 * allowed.sum()


# --- joining


def test_what_lies_apart_is_joined_by_a_narrow_way(ball):
    """Between two caps of a tenth of the sphere, at right angles, it is 90 - 2 * 36.9 degrees or 0.28."""
    up, side = cap(ball, [0, 0, 1], 0.1), cap(ball, [1, 0, 0], 0.1)
    result = joined(up, side, ball.vertices, ball.faces, 1.0)
    ways = result & ~up & ~side
    assert loops(ball, up | side) == (2, 1) and loops(ball, result) == (1, 1)
    assert 0 < ways.sum() <= 0.4 / ball.edges_unique_length.mean()
    assert (joined(up, side, ball.vertices, ball.faces, 0.2) == up).all(), "farther than it may be"
    assert (joined(up, side & (np.cumsum(side) < 6), ball.vertices, ball.faces, 1.0) == up).all(), "too small"


# --- where


def evidence(ball, empty: np.ndarray) -> Residuals:
    """The surface is explained badly where it is empty, and then what is behind it hardly worse."""
    now = np.where(empty, 4.0, 1.0)
    return Residuals(np.full(len(empty), 50.0), 50 * now, 50 * np.where(empty, 6.0, 40.0))


@pytest.mark.parametrize(("reach", "apart"), [(0.5, False), (3.0, True)])
def test_openings_grow_into_what_is_empty_near_them(ball, reach, apart):
    """What is as empty opposite, 1.7 away, opens only if that is near enough."""
    up, wide, down = (cap(ball, [0, 0, z], share) for z, share in ((1, 0.05), (1, 0.15), (-1, 0.1)))
    values, smooth = np.where(up, -1.0, 1.0), MeshDiffusion(ball.faces, len(up), 0.5)
    found = evidence(ball, wide | down)
    added = near_openings(values, ball.vertices, ball.faces, found, smooth, reach)
    assert not (added & up).any()
    np.testing.assert_array_equal(added[~up & cap(ball, [0, 0, 1], 0.13)], True)
    np.testing.assert_array_equal(added[cap(ball, [0, 0, -1], 0.08)], apart)
    assert not added[~cap(ball, [0, 0, 1], 0.18) & ~cap(ball, [0, 0, -1], 0.13)].any()
    assert loops(ball, up | added) == (1 + apart, 1)


def test_openings_grow_over_islands(ball):
    """Around one they would meet themselves: a strip would stay, and the island."""
    up, wide = cap(ball, [0, 0, 1], 0.05), cap(ball, [0, 0, 1], 0.3)
    island = np.isin(np.arange(len(up)), ball.vertex_neighbors[near := np.argmin(
        np.linalg.norm(ball.vertices - RADIUS * np.array([0.6, 0, 0.8]), axis=1))] + [near])
    assert 4 < island.sum() < 12 and not (island & (up | ~wide)).any()
    smooth = MeshDiffusion(ball.faces, len(up), 0.01)
    added = near_openings(np.where(up, -1.0, 1.0), ball.vertices, ball.faces, evidence(ball, wide & ~island),
                          smooth, 0.5)
    np.testing.assert_array_equal(up | added, wide)


@pytest.mark.parametrize("change", ["explained as well as the rest", "much worse without", "hardly met"])
def test_what_is_not_clearly_empty_stays(ball, change):
    up, wide = cap(ball, [0, 0, 1], 0.05), cap(ball, [0, 0, 1], 0.15)
    found = evidence(ball, wide)
    found = {"explained as well as the rest": replace(found, now=found.rays, without=2 * found.rays),
             "much worse without": replace(found, without=np.where(wide, 20 * found.now, found.without)),
             "hardly met": Residuals(*(np.where(wide, 0.3, 1) * sums
                                       for sums in (found.rays, found.now, found.without)))}[change]
    smooth = MeshDiffusion(ball.faces, len(up), 0.5)
    assert not near_openings(np.where(up, -1.0, 1.0), ball.vertices, ball.faces, found, smooth, 3.0).any()
