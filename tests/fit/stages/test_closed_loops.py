"""Which of the movements is taken where the lattice closes a loop of the best."""

from types import SimpleNamespace

import numpy as np
import pytest
from silent_steps import Silent

from gshell_mi.fit.judge import Verdict
from gshell_mi.fit.stages import revoxelise


def fit(gain: float) -> SimpleNamespace:
    """A fit whose judge finds that gain, with a noise of 1."""

    def decide(before, after):
        assert (before, after) == (("start", "faces"), ("refined", "faces"))
        return Verdict(*(np.array([value]) for value in (1.0, 1.0, gain, 1.0)))

    return SimpleNamespace(judge=SimpleNamespace(decide=decide), mesh=lambda found: (found.fields, "faces"))


def surface(name: str) -> SimpleNamespace:
    return SimpleNamespace(fields=name)


@pytest.mark.parametrize(
    ("made", "gain", "stage", "judged"),
    [
        ([("folded", "folds", True), ("refined", "refinement", True)], 9, "folds", False),
        ([("refined", "refinement", False), ("start", "start", True)], 9, "refinement", True),
        ([("refined", "refinement", False), ("start", "start", True)], 1, "start", True),
        # The best of what has closed a loop is asked for, against the best that has not.
        (
            [("refined", "folds", False), ("worse", "refinement", False), ("start", "start", True)],
            9,
            "folds",
            True,
        ),
    ],
)
def test_views_decide_on_what_has_closed_a_loop(made, gain, stage, judged, monkeypatch):
    found = ((surface(name), by, has_loops) for name, by, has_loops in made)
    monkeypatch.setattr(revoxelise, "_made", lambda *given: found)
    steps = Silent()
    assert revoxelise._taken(fit(gain), None, (), surface("whole"), steps)[1] == stage
    assert ("closed_loops_verdict" in steps.facts) == judged


def test_what_nothing_comes_of_stays_as_it_is(monkeypatch):
    monkeypatch.setattr(revoxelise, "_made", lambda *given: iter(()))
    kept, stage = revoxelise._taken(fit(9), None, (), surface("whole"), Silent())
    assert (kept.fields, stage) == ("whole", "")


@pytest.mark.parametrize(
    ("pieces", "gain", "first"),
    [((3, 2), 1, "cut"), ((3, 2), 9, "as found"), ((2, 2), 9, "cut")],
    ids=["as good", "surely worse", "not apart"],
)
def test_a_cut_that_falls_apart_counts_unless_views_deny_it(pieces, gain, first, monkeypatch):
    """Without sides that have held its pieces together."""
    cuts = [
        SimpleNamespace(name=name, topology=SimpleNamespace(components=count))
        for name, count in zip(("cut", "as found"), pieces, strict=True)
    ]
    monkeypatch.setattr(revoxelise, "_cuts", lambda *given: cuts)
    monkeypatch.setattr(
        revoxelise, "_revoxelised", lambda fit, template, moved, cut, start: (cut.name, "folds", True)
    )
    monkeypatch.setattr(
        revoxelise, "compared", lambda *given: Verdict(*(np.array([x]) for x in (1.0, 1.0, gain, 1.0)))
    )
    template = SimpleNamespace(vertices=np.zeros((1, 3)))
    moved = SimpleNamespace(positions=np.ones((1, 3)))
    made = revoxelise._made(SimpleNamespace(cell=lambda surface: 1.0), template, [moved], None)
    assert next(name for name, *_ in made) == first
