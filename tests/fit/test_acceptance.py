"""Which openings and islands stay, for errors that are given."""

from types import SimpleNamespace

import numpy as np
import pytest
from cap import cap
from scripted_judge import ScriptedJudge

from gshell_mi.fit.acceptance import close_rejected, close_shallow, open_rejected
from gshell_mi.fit.judge import Verdict
from gshell_mi.topology import equal_patches


def _closed(ball, logits, error, **noise):
    judge = ScriptedJudge(len(ball.vertices), error, **noise)
    template = judge.shown((ball.vertices, ball.faces))
    return close_rejected(logits, template, judge, template.whole), judge


def test_an_opening_stays_if_it_explains_the_images(ball):
    """Two openings: through the upper one the error falls to a half, through the lower one to 0.95."""
    up, down = cap(ball, [0, 0, 1], 0.1), cap(ball, [0, 0, -1], 0.1)
    logits = np.where(up | down, -1.0, 2.0)

    def error(opaque):
        return np.where(opaque, 1.0, np.where(up, 0.5, 0.95))

    result, judge = _closed(ball, logits, error)
    np.testing.assert_array_equal(result <= 0, up)
    np.testing.assert_array_equal(np.abs(result), np.abs(logits))
    assert judge.asked[0].all(), "compared with the closed template"
    np.testing.assert_array_equal(_closed(ball, logits, error, noise=0.01)[0], logits)


@pytest.mark.parametrize(("noise", "stays"), [(0.2, True), (0.5, False)])
def test_a_gain_counts_by_its_noise_alone(ball, noise, stays):
    up = cap(ball, [0, 0, 1], 0.1)
    result, _ = _closed(ball, np.where(up, -1.0, 2.0), lambda opaque: np.where(opaque, 1.0, 0.5), noise=noise)
    np.testing.assert_array_equal(result <= 0, up & stays)


@pytest.mark.parametrize(
    ("after", "noise", "grows"), [(0.9, 0.5, True), (1.1, 0.5, False), (0.9, np.inf, False)]
)
def test_a_justified_opening_grows_by_what_explains_more(ball, after, noise, grows):
    """Its rim only moves: no loop is added, and a gain of a fifth of a standard error counts."""
    up, wide, apart = cap(ball, [0, 0, 1], 0.1), cap(ball, [0, 0, 1], 0.2), cap(ball, [0, 0, -1], 0.1)
    judge = ScriptedJudge(len(ball.vertices), lambda opaque: np.where(opaque, 1.0, after), noise=noise)
    template = judge.shown((ball.vertices, ball.faces))
    logits = np.where(wide | apart, -1.0, 2.0)
    result = close_rejected(logits, template, judge, template.part(np.where(up, -1.0, 1.0)), up)
    np.testing.assert_array_equal(result <= 0, wide if grows else up)


def test_the_error_counts_per_opening_not_per_vertex(ball):
    """Half of an opening's vertices may get worse if the other half gains more."""
    up = cap(ball, [0, 0, 1], 0.1)
    half = up & (ball.vertices[:, 0] > 0)
    logits = np.where(up, -1.0, 1.0)
    result, _ = _closed(ball, logits, lambda opaque: np.where(opaque, 1.0, np.where(half, 1.1, 0.1)))
    np.testing.assert_array_equal(result, logits)


def test_an_opening_is_not_blamed_for_what_is_missing_behind_it(ball):
    """Through the upper opening one sees the lower one, which should not be there."""
    up, down = cap(ball, [0, 0, 1], 0.1), cap(ball, [0, 0, -1], 0.1)

    def error(opaque):
        behind = 3.0 if not opaque[down].any() else 0.5
        return np.where(opaque, 1.0, np.where(up, behind, 30.0))

    result, _ = _closed(ball, np.where(up | down, -1.0, 2.0), error)
    np.testing.assert_array_equal(result <= 0, up)


def test_the_best_of_many_has_to_be_better_than_one_alone(ball):
    """An opening by 2.3 standard errors stays, but not as the only one of six that the images speak for."""
    others = [cap(ball, direction, 0.02) for direction in np.vstack([np.eye(3), -np.eye(3)])[1:]]
    first, wrong = cap(ball, [1, 0, 0], 0.02), np.any(others, axis=0)

    def error(opaque):
        return np.where(opaque, 1.0, np.where(wrong, 1.3, np.exp(-0.115)))

    alone, _ = _closed(ball, np.where(first, -1.0, 1.0), error)
    np.testing.assert_array_equal(alone <= 0, first)
    assert (_closed(ball, np.where(first | wrong, -1.0, 1.0), error)[0] > 0).all()


def test_many_rejected_openings_go_at_once_in_the_end(ball):
    directions = np.vstack([np.eye(3), -np.eye(3)])
    opened = np.any([cap(ball, direction, 0.02) for direction in directions], axis=0)
    worse = np.exp(3.0 ** (4 + ball.vertices @ [1, 2, 3]) / 100)
    result, judge = _closed(ball, np.where(opened, -1.0, 1.0), lambda opaque: np.where(opaque, 1.0, worse))
    assert (result > 0).all()
    assert len(judge.asked) <= 1 + 7, "closed, and seven rounds for six openings"


def test_if_all_is_open_all_closes(ball):
    result, judge = _closed(ball, np.full(len(ball.vertices), -1.0), None)
    assert (result > 0).all() and len(judge.asked) == 1, "closed"


def test_what_a_neck_joins_is_judged_apart(ball):
    up, side = cap(ball, [0, 0, 1], 0.1), cap(ball, [1, 0, 0], 0.1)
    x, y, z = ball.vertices.T
    neck = (np.abs(y) < 0.07) & (x > 0) & (z > 0)
    opened = up | side | neck
    assert len(np.unique(equal_patches(opened, ball.faces)[opened])) == 1
    result, _ = _closed(
        ball, np.where(opened, -1.0, 1.0), lambda opaque: np.where(opaque, 1.0, np.where(side, 2.0, 0.1))
    )
    assert (result[up] < 0).all() and (result[side] > 0).all()


def test_an_opening_is_trimmed_where_its_own_vertices_speak_against_it(ball):
    """The opening is right at the pole, and runs on into what is much worse for it."""
    opened, right = cap(ball, [0, 0, 1], 0.3), cap(ball, [0, 0, 1], 0.2)

    def error(better):
        return lambda opaque: np.where(opaque, 1.0, np.where(better, 0.2, 30.0))

    result, _ = _closed(ball, np.where(opened, -1.0, 1.0), error(right))
    inner, outer = cap(ball, [0, 0, 1], 0.15), cap(ball, [0, 0, 1], 0.25)
    assert (result[inner] < 0).all() and (result[~outer] > 0).all()
    crumbs, _ = _closed(ball, np.where(opened, -1.0, 1.0), error(cap(ball, [0, 0, 1], 0.05)))
    assert (crumbs > 0).all()


@pytest.mark.parametrize(("without", "stays"), [(1.05, False), (1.5, True)])
def test_an_island_has_to_be_justified(ball, without, stays):
    island, around = cap(ball, [0, 0, 1], 0.02), cap(ball, [0, 0, 1], 0.2)
    logits = np.where(around & ~island, -1.0, 2.0)
    judge = ScriptedJudge(len(logits), lambda opaque: np.where(opaque | ~island, 1.0, without))
    result = open_rejected(logits, judge.shown((ball.vertices, ball.faces)), judge)
    np.testing.assert_array_equal(result > 0, ~around | island if stays else ~around)


def test_without_islands_nothing_is_asked(ball):
    logits = np.where(cap(ball, [0, 0, 1], 0.1), -1.0, 1.0)
    judge = ScriptedJudge(len(logits), None)
    assert open_rejected(logits, judge.shown((ball.vertices, ball.faces)), judge) is logits


def test_an_island_that_has_been_justified_is_not_asked_for(ball):
    island, around = cap(ball, [0, 0, 1], 0.02), cap(ball, [0, 0, 1], 0.2)
    logits = np.where(around & ~island, -1.0, 2.0)
    judge = ScriptedJudge(len(logits), None)
    assert open_rejected(logits, judge.shown((ball.vertices, ball.faces)), judge, island) is logits


def test_nothing_open_nothing_asked(ball):
    logits = np.ones(len(ball.vertices))
    judge = ScriptedJudge(len(logits), None)
    assert close_rejected(logits, judge.shown((ball.vertices, ball.faces)), judge, None) is logits


class SheetJudge:
    """The truth is a sheet at z = -0.1: what is seen is explained as badly as it is far from that."""

    def __init__(self, error: float):
        self.error = error

    def shown(self, mesh, like=None):
        def part(values):
            return np.where(values > 0, np.abs(mesh[0][:, 2] + 0.1) + 0.01, self.error)

        return SimpleNamespace(mesh=mesh, part=part)

    def compare(self, before, after, place, where):
        told, count = place >= 0, place.max() + 1
        first, second = (np.bincount(place[told], error[told], count) for error in (before, after))
        return Verdict(first, second, np.log(first / second), np.full(count, 0.05))


@pytest.mark.parametrize(
    ("thickness", "error", "stays"),
    [(0.4, 0.05, False), (0.4, 1e-3, True), (0.02, 0.05, True)],
    ids=["another side of a sheet", "better than the other side", "not thin"],
)
def test_what_a_lid_on_the_other_side_explains_is_no_opening(ball, thickness, error, stays):
    disc = ball.vertices * [1, 1, 0.1]
    logits, judge = np.where(ball.vertices[:, 2] > 0.4, -1.0, 1.0), SheetJudge(error)
    template = judge.shown((disc, ball.faces))
    result = close_shallow(logits, template, judge, thickness)
    np.testing.assert_array_equal(result, logits if stays else np.abs(logits))
    closed = np.abs(logits)
    assert close_shallow(closed, template, judge, thickness) is closed
