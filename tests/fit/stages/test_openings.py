"""What false openings hide is found in further rounds."""

from functools import partial

import numpy as np
import pytest
import trimesh
from scripted_judge import ScriptedJudge

from gshell_mi.fit.stages.openings import find_openings, justified
from gshell_mi.template.msdf import clean_opacity
from gshell_mi.topology import equal_patches

BALL = trimesh.creation.icosphere(4)
VERTICES, FACES, THIN = np.array(BALL.vertices), np.array(BALL.faces), 0.05


class ScriptedRadiance:
    """Proposes caps: at first those that ``first`` names, and ``behind`` only where ``false`` rests.

    Through ``false`` the images are explained worse, through all others better.
    """

    vertex_count = len(VERTICES)

    def __init__(self, first: tuple, false: tuple, behind: tuple):
        self.false, self.behind = (
            np.logical_or.reduce([self.cap(axis) for axis in axes], initial=False) for axes in (false, behind)
        )
        self.open = np.logical_or.reduce([self.cap(axis) for axis in first])
        self.rounds = 0

    @staticmethod
    def cap(axis) -> np.ndarray:
        return VERTICES @ np.array(axis) > 0.85

    def smoothed_logits(self) -> np.ndarray:
        return np.where(self.open, -2.0, 2.0)

    def begin_again(self, opaque: np.ndarray, opened: np.ndarray) -> None:
        assert not (opaque & opened).any()
        assert opaque[self.false].all()
        # Forgets one vertex of what it had opened: a rim that differs.
        self.open = opened | self.behind
        self.open[np.flatnonzero(opened)[:1]] = False

    def train(self, again: int) -> None:
        self.rounds += 1
        assert again == self.rounds

    def error(self, opaque: np.ndarray) -> np.ndarray:
        return np.where(opaque, 1.0, np.where(self.false, 3.0, 0.3))


def found_openings(appearance: ScriptedRadiance, rounds: int = 3) -> np.ndarray:
    clean = partial(clean_opacity, vertices=VERTICES, faces=FACES, min_area=0.005)
    judge = ScriptedJudge(len(VERTICES), appearance.error)
    template, train = judge.shown((VERTICES, FACES)), appearance.train
    return find_openings(appearance, template, judge, rounds, THIN, clean, train) <= 0


@pytest.mark.parametrize(
    ("false", "behind", "openings", "rounds"),
    [
        ((), (), 1, 0),
        (((0, 1, 0),), (), 1, 1),
        (((0, 1, 0),), ((1, 0, 0),), 2, 2),
        (((0, 1, 0),), ((1, 0, 0), (-1, 0, 0)), 3, 2),
    ],
)
def test_rounds_go_on_as_long_as_they_find_openings(false, behind, openings, rounds):
    appearance = ScriptedRadiance(((0, 0, 1), *false), false, behind)
    opened = found_openings(appearance)
    assert appearance.rounds == rounds
    assert len(np.unique(equal_patches(opened, FACES)[opened])) == openings
    assert opened[appearance.cap((0, 0, 1))].all(), "what was justified stays"
    assert not opened[appearance.false].any()


def test_false_openings_alone_are_reason_enough_for_another_round():
    appearance = ScriptedRadiance(((0, 1, 0),), ((0, 1, 0),), ((0, 0, 1),))
    opened = found_openings(appearance)
    np.testing.assert_array_equal(opened, appearance.cap((0, 0, 1)))


def test_no_rounds_that_are_not_asked_for():
    appearance = ScriptedRadiance(((0, 0, 1), (0, 1, 0)), ((0, 1, 0),), ((1, 0, 0),))
    opened = found_openings(appearance, rounds=0)
    assert appearance.rounds == 0
    np.testing.assert_array_equal(opened, appearance.cap((0, 0, 1)))


def test_where_nearly_all_has_become_transparent_the_most_transparent_part_is_proposed():
    """Gloss: all but the equator is open, and the true opening the most."""

    class Glossy(ScriptedRadiance):
        def smoothed_logits(self) -> np.ndarray:
            return np.where(self.cap((0, 0, 1)), -2.0, np.where(np.abs(VERTICES[:, 2]) < 0.2, 2.0, -1.0))

    appearance = Glossy(((0, 0, 1),), (), ())
    appearance.false = ~appearance.cap((0, 0, 1))
    np.testing.assert_array_equal(found_openings(appearance, rounds=0), appearance.cap((0, 0, 1)))


def test_what_a_later_opening_shows_to_be_wrong_does_not_stay():
    """A hole seems justified as long as the mouth that one looks out of through it is closed, as gloss beside
    it is proposed together with it."""
    hole, mouth, gloss = np.eye(3, dtype=bool)
    smoothed = np.where(hole, -1.0, np.where(mouth, -2.0, -0.5))

    def judged(candidate: np.ndarray) -> np.ndarray:
        wrong = ~hole if (candidate <= 0)[gloss].any() else hole if (candidate <= 0)[mouth].any() else gloss
        return np.where(wrong, np.abs(candidate), candidate)

    logits = justified(smoothed, np.full(3, 2.0), lambda logits: logits, judged)
    assert ((logits <= 0) == mouth).all()
