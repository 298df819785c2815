"""Details once more on a finer lattice: judged as they come out of it."""

from dataclasses import replace

import numpy as np
import pytest
from silent_steps import Silent

from gshell_mi.fit.judge import Verdict
from gshell_mi.fit.lattices import Lattices
from gshell_mi.fit.stage import Fit
from gshell_mi.fit.stages import fine_folds
from gshell_mi.fit.stages.fine_folds import FineFolds
from gshell_mi.fit.stages.hull import Hull
from gshell_mi.fit.surface import Moved, Seen
from gshell_mi.fit.template import template_of

SMALL = {"lattice.start_resolution": 16, "resolution": 24}


@pytest.fixture(scope="module")
def fit(exact):
    config = exact.config.changed(SMALL)
    return Fit(exact.scene, config, Lattices.of(exact.scene.subject, config))


def with_fields(surface, fields):
    """The surface with fields on some lattice, all white."""
    count = fields.lattice.vertex_count
    white = Seen(np.ones((count, 3), np.float32), np.ones(count, bool), np.float32(1))
    return replace(surface, fields=fields, hull=None, seen=white)


@pytest.fixture(scope="module")
def hull(fit):
    """The bowl with a lid, on the coarse lattice."""
    hull = Hull(fit.config.hull).run(fit, None, Silent())
    return with_fields(hull, hull.fields)


@pytest.fixture(scope="module")
def fine(fit, hull):
    """The same on the finer one."""
    lattice = fit.lattices.volume
    return with_fields(hull, hull.fields.to_lattice(lattice.resolution, lattice.grid))


def verdict(gain):
    return Verdict(*(np.array([value]) for value in (1.0, 1.0, gain, 1.0)))


def test_the_surface_is_where_it_was_moved_to(monkeypatch, fit, fine):
    """By a tenth of its distance from the middle of the scene."""
    subject = fit.scene.subject

    def moved(self, fit, surface, steps):
        template = template_of(subject, surface)
        positions = (1.1 * template.vertices).astype(np.float32)
        return replace(surface, moved=(Moved(self.name, positions, np.ones_like(positions)),))

    monkeypatch.setattr(fine_folds.Refinement, "run", moved)
    monkeypatch.setattr(fine_folds, "compared", lambda *given: verdict(3.0))
    found = FineFolds(fit.config.folds).run(fit, fine, Silent())
    assert found.lattice.resolution == fine.lattice.resolution and not found.moved
    before, after = (np.ptp(subject.surface_of(each.fields).to_numpy()[0], axis=0) for each in (fine, found))
    np.testing.assert_allclose(after, 1.1 * before, atol=0.5 * fit.cell(fine))


def test_the_hulls_own_lattice_has_had_them(fit, hull):
    assert FineFolds(fit.config.folds).run(fit, hull, Silent()) is hull


def test_none_are_asked_for(fit, fine):
    config = fit.config.changed({"folds.iterations": 0})
    assert FineFolds(config.folds).run(fit, fine, Silent()) is fine


@pytest.mark.parametrize(
    ("taken", "gain", "kept"),
    [("fine_folds", 3.0, True), ("fine_folds", 1.0, False), ("start", 3.0, False), ("", 3.0, False)],
)
def test_new_fields_are_judged(monkeypatch, fit, fine, taken, gain, kept):
    """By two standard errors, unless none come out that keep the movement."""
    monkeypatch.setattr(fine_folds.Refinement, "run", lambda *given: replace(fine, moved=("moved",)))
    made = replace(fine, settled=True)
    monkeypatch.setattr(fine_folds, "best_moved", lambda *given: (made, taken))
    monkeypatch.setattr(fine_folds, "compared", lambda *given: verdict(gain))
    steps = Silent()
    assert FineFolds(fit.config.folds).run(fit, fine, steps) is (made if kept else fine)
    assert steps.facts == {"fine_folds_kept": kept}
