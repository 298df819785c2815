"""Which openings and islands stay, for image errors that are given."""

import numpy as np
import pytest
from cap import cap

from gshell_mi.fit.radiance.acceptance import close_rejected, open_rejected
from gshell_mi.topology import equal_patches


def test_an_opening_stays_if_it_explains_the_images(ball):
    """Two openings: through the upper one the error falls to a half, through the lower one to 0.9."""
    up, down = cap(ball, [0, 0, 1], 0.1), cap(ball, [0, 0, -1], 0.1)
    logits = np.where(up | down, -1.0, 2.0)
    asked = []

    def error(opaque):
        asked.append(opaque)
        return np.where(opaque, 1.0, np.where(up, 0.5, 0.9))[None]

    result = close_rejected(logits, ball.faces, error, gain=0.8)
    np.testing.assert_array_equal(result <= 0, up)
    np.testing.assert_array_equal(np.abs(result), np.abs(logits))
    assert asked[0].all(), "compared with the closed template"
    np.testing.assert_array_equal(asked[1], logits > 0)
    np.testing.assert_array_equal(close_rejected(logits, ball.faces, error, gain=0.95), logits)


def test_at_a_gain_of_nothing_all_openings_close(ball):
    up = cap(ball, [0, 0, 1], 0.1)
    result = close_rejected(np.where(up, -1.0, 2.0), ball.faces,
                            lambda opaque: np.where(opaque, 1.0, 1e-6)[None], gain=0.0)
    assert (result > 0).all()


def test_the_error_counts_per_opening_not_per_vertex(ball):
    """Half of an opening's vertices may get worse if the other half gains more."""
    up = cap(ball, [0, 0, 1], 0.1)
    half = up & (ball.vertices[:, 0] > 0)
    logits = np.where(up, -1.0, 1.0)

    def error(opaque):
        return np.where(opaque, 1.0, np.where(half, 1.1, 0.1))[None]

    np.testing.assert_array_equal(close_rejected(logits, ball.faces, error, gain=0.8), logits)


def test_an_opening_is_not_blamed_for_what_is_missing_behind_it(ball):
    """Through the upper opening one sees the lower one, which should not be there."""
    up, down = cap(ball, [0, 0, 1], 0.1), cap(ball, [0, 0, -1], 0.1)

    def error(opaque):
        behind = 3.0 if not opaque[down].any() else 0.5
        return np.where(opaque, 1.0, np.where(up, behind, 8.0))[None]

    result = close_rejected(np.where(up | down, -1.0, 2.0), ball.faces, error, gain=0.8)
    np.testing.assert_array_equal(result <= 0, up)


def test_many_unjustified_openings_go_at_once_in_the_end(ball):
    directions = np.vstack([np.eye(3), -np.eye(3)])
    opened = np.any([cap(ball, direction, 0.02) for direction in directions], axis=0)
    rounds = []

    def error(opaque):
        rounds.append(opaque)
        return np.where(opaque, 1.0, 3.0 ** (8 + ball.vertices @ [1, 2, 3]))[None]

    assert (close_rejected(np.where(opened, -1.0, 1.0), ball.faces, error, gain=0.8) > 0).all()
    assert len(rounds) == 1 + 5, "closed, and five rounds for six openings"


def test_what_a_neck_joins_is_judged_apart(ball):
    up, side = cap(ball, [0, 0, 1], 0.1), cap(ball, [1, 0, 0], 0.1)
    x, y, z = ball.vertices.T
    neck = (np.abs(y) < 0.07) & (x > 0) & (z > 0)
    opened = up | side | neck
    assert len(np.unique(equal_patches(opened, ball.faces)[opened])) == 1
    result = close_rejected(np.where(opened, -1.0, 1.0), ball.faces,
                            lambda opaque: np.where(opaque, 1.0, np.where(side, 2.0, 0.1))[None], gain=0.8)
    assert (result[up] < 0).all() and (result[side] > 0).all()


@pytest.mark.parametrize(("share", "every", "covered", "stays"), [
    (0.03, 0.5, 0.5, True),
    (0.03, 0.5, 0.9, False),    # beside a handle
    (0.03, 0.7, 0.5, False),    # 0.8 is not enough for so small a one
    (0.10, 0.7, 1.0, True),     # a dark hem
    (0.10, 0.9, 0.5, False),
])
def test_a_small_opening_needs_better_reasons(ball, share, every, covered, stays):
    up = cap(ball, [0, 0, 1], share)
    result = close_rejected(
        np.where(up, -1.0, 1.0), ball.faces,
        lambda opaque: np.stack([np.where(opaque, 1.0, ratio) for ratio in (every, covered)]), gain=0.8)
    np.testing.assert_array_equal(result <= 0, up & stays)


@pytest.mark.parametrize(("without", "stays"), [(1.05, False), (1.5, True)])
def test_an_island_has_to_be_justified(ball, without, stays):
    island, around = cap(ball, [0, 0, 1], 0.02), cap(ball, [0, 0, 1], 0.2)
    logits = np.where(around & ~island, -1.0, 2.0)
    result = open_rejected(logits, ball.faces,
                           lambda opaque: np.where(opaque | ~island, 1.0, without)[None], gain=0.9)
    np.testing.assert_array_equal(result > 0, ~around | island if stays else ~around)


def test_without_islands_nothing_is_asked(ball):
    logits = np.where(cap(ball, [0, 0, 1], 0.1), -1.0, 1.0)
    assert open_rejected(logits, ball.faces, None, gain=0.9) is logits


def test_nothing_open_nothing_asked(ball):
    logits = np.ones(len(ball.vertices))
    assert close_rejected(logits, ball.faces, None, gain=0.8) is logits
