"""Openings grow to where the finished surface ends, and none come."""

import mitsuba as mi
import numpy as np
import pytest
from cap import cap
from silent_steps import Silent

from gshell_mi.fit.stages.revision import Revision
from gshell_mi.fit.stages.rims import Rims, grown
from gshell_mi.topology import topology


def counted(fit, surface):
    return topology(*fit.scene.subject.surface_of(surface.fields).to_numpy()[:2])


def test_what_is_left_of_a_lid_goes(fit, hull):
    bowl = Revision(fit.config.openings).run(fit, hull, Silent())
    x, y, _ = bowl.lattice.points(mi.Float).numpy()
    msdf = np.where((x > 0.1) & (y > -0.3), bowl.lattice.spacing, bowl.fields.msdf).astype(np.float32)
    steps, whole = Silent(), counted(fit, bowl)
    lidded = bowl.with_fields(msdf=msdf)
    assert counted(fit, lidded).boundary_length < 0.9 * whole.boundary_length
    found = Rims(fit.config.openings).run(fit, lidded, steps)
    assert steps.facts["rims_moved"]
    assert counted(fit, found).boundary_loops == 1
    assert counted(fit, found).boundary_length == pytest.approx(whole.boundary_length, rel=0.05)
    again = Rims(fit.config.openings).run(fit, bowl, steps)
    assert counted(fit, again).boundary_length == pytest.approx(whole.boundary_length, rel=0.05)


def test_what_is_closed_stays_so(fit, hull):
    steps = Silent()
    assert Rims(fit.config.openings).run(fit, hull, steps) is hull and not steps.facts


def test_what_is_apart_does_not_grow(ball):
    up, wide, apart = cap(ball, [0, 0, 1], 0.1), cap(ball, [0, 0, 1], 0.2), cap(ball, [0, 0, -1], 0.1)
    np.testing.assert_array_equal(grown(wide | apart, up, ball.faces), wide & ~up)
    assert not grown(up, up, ball.faces).any()
