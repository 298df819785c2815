"""Caps go on as the surface around them does."""

import numpy as np
import pytest
from cap import cap

from gshell_mi.template.caps import Recesses, facing_one_way, least_bent

RADIUS = 0.6


def test_a_dent_in_a_ball_is_taken_back(ball):
    free = cap(ball, [0, 0, 1], 0.05)
    dented = np.where(free[:, None], 0.8 * ball.vertices, ball.vertices)
    moved = least_bent(dented, ball.faces, free)
    np.testing.assert_array_equal(moved[~free], dented[~free])
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1, atol=0.005)


def test_nothing_is_free(ball):
    none = np.zeros(len(ball.vertices), bool)
    np.testing.assert_array_equal(least_bent(ball.vertices, ball.faces, none), ball.vertices)


def test_without_surroundings_a_cap_stays_finite(ball):
    assert np.isfinite(least_bent(ball.vertices, ball.faces, np.ones(len(ball.vertices), bool))).all()


@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_a_recess_has_a_floor_and_walls(ball, unit):
    """Of two depths at once, where the ball is nearly flat."""
    place = np.where(cap(ball, [0, 0, 1], 0.02), 0, np.where(cap(ball, [1, 0, 0], 0.02), 1, -1))
    recesses = Recesses(unit * ball.vertices, ball.faces, place)
    deep = np.array([0.03, 0.5])
    moved = recesses.at(unit * deep) / unit
    np.testing.assert_allclose(moved[place < 0], ball.vertices[place < 0], atol=1e-12)
    for index, axis in enumerate(np.eye(3)[[2, 0]]):
        at = place == index
        depth = (ball.vertices - moved)[at] @ axis
        assert depth.max() == pytest.approx(deep[index], rel=0.02) and depth.min() > 0
        np.testing.assert_allclose(moved[at] + np.outer(depth, axis), ball.vertices[at], atol=0.02)
        middle = np.linalg.norm(ball.vertices[at] - axis, axis=1) < 0.05
        assert depth[middle].min() == pytest.approx(deep[index], rel=0.1)


def test_a_recess_ends_half_way_to_what_is_behind_it(ball):
    place = np.where(cap(ball, [0, 0, 1], 0.05), 0, -1)
    recesses = Recesses(ball.vertices, ball.faces, place)
    moved = recesses.at(10.0)
    assert moved[place == 0, 2].min() == pytest.approx(0, abs=0.01)
    assert recesses.depths(0.3) == pytest.approx([0.3, 0.6, 1.2])


def test_a_recess_leaves_some_thickness_where_there_is_as_much(ball):
    """A disc that is thinner to its rim."""
    flat = ball.vertices * [1, 1, 0.1]
    place = np.where(ball.vertices[:, 2] > 0.05, 0, -1)
    thickness = 2 * flat[place == 0, 2]
    left = Recesses(flat, ball.faces, place, kept=0.12).at(10.0)[place == 0, 2] + thickness / 2
    np.testing.assert_allclose(left, np.clip(0.12, thickness / 2, thickness), atol=0.01)


def test_what_goes_around_an_edge_faces_two_ways(ball):
    """The rim of a disc, and a cap beside it that faces one way only."""
    flat, radius = ball.vertices * [1, 1, 0.1], np.hypot(*ball.vertices.T[:2])
    place = np.where(radius > 0.8, 0, np.where(cap(ball, [0, 0, 1], 0.05), 1, -1))
    patch = facing_one_way(flat, ball.faces, place)
    sides = [np.unique(patch[(place == 0) & (sign * ball.vertices[:, 2] > 0.01)]) for sign in (-1, 1)]
    assert len(sides[0]) == len(sides[1]) == 1 and sides[0] != sides[1]
    assert len(np.unique(patch[place == 1])) == 1 and not np.isin(patch[place < 0], patch[place >= 0]).any()


def test_only_thin_parts_have_another_side(ball):
    """A disc, whose upper side comes to lie on the lower one, or stays where that is too far."""
    flat = ball.vertices * [1, 1, 0.1]
    place = np.where(ball.vertices[:, 2] > 0.3, 0, -1)
    thick = 2 * flat[:, 2].max()
    np.testing.assert_array_equal(Recesses(flat, ball.faces, place).on_other_sides(0.2 * thick), flat)
    moved = Recesses(flat, ball.faces, place).on_other_sides(1.1 * thick)
    np.testing.assert_array_equal(moved[place < 0], flat[place < 0])
    top = ball.vertices[:, 2] > 0.6
    np.testing.assert_allclose(moved[top, 2], -0.8 * flat[top, 2], atol=0.02 * thick)
