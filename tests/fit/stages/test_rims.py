"""Openings grow to where the finished surface ends, and none come."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from bowl import RADIUS
from cap import cap
from silent_steps import Silent

from gshell_mi.fit.stages.revision import cut_template
from gshell_mi.fit.stages.rims import Rims, _with_as_many_loops, grown
from gshell_mi.topology import topology


def counted(fit, surface):
    return topology(*fit.mesh(surface))


def area(fit, surface):
    return trimesh.Trimesh(*fit.mesh(surface), process=False).area


@pytest.fixture(scope="module")
def bowl(exact, hull):
    """The lower half of a sphere, as it is."""
    vertices = hull.lattice.vertex_positions()
    distance = np.linalg.norm(vertices, axis=1) - RADIUS / exact.scene.subject.length_scale
    return hull.with_fields(sdf=distance.astype(np.float32), msdf=(-vertices[:, 1]).astype(np.float32))


def test_what_is_left_of_a_lid_goes(exact, bowl):
    x, y, _ = bowl.lattice.points(mi.Float).numpy()
    msdf = np.where((x > 0.1) & (y > -0.1), bowl.lattice.spacing, bowl.fields.msdf).astype(np.float32)
    steps, lidded = Silent(), bowl.with_fields(msdf=msdf)
    assert area(exact, lidded) > 1.2 * area(exact, bowl)
    found = Rims(exact.config.openings).run(exact, lidded, steps)
    assert steps.facts["rims_moved"] and counted(exact, found).boundary_loops == 1
    assert area(exact, found) == pytest.approx(area(exact, bowl), rel=0.05)


def test_a_rim_that_is_right_stays(exact, bowl):
    steps = Silent()
    found = Rims(exact.config.openings).run(exact, bowl, steps)
    assert area(exact, found) == pytest.approx(area(exact, bowl), rel=0.02)


def test_growth_adds_no_loop(exact, bowl):
    """A ring at the mouth is taken, a hole in the bottom is not."""
    template, values = cut_template(exact, bowl)
    height = template.to_numpy()[0][:, 1]
    ring, hole = (values > 0) & (height > -0.2), height < -0.5
    assert ring.any() and hole.any()
    for growth in (ring | hole, ring):
        np.testing.assert_array_equal(_with_as_many_loops(exact, bowl, template, values, growth), ring)
    assert not _with_as_many_loops(exact, bowl, template, values, hole).any()


def test_what_is_closed_stays_so(fit, hull):
    steps = Silent()
    assert Rims(fit.config.openings).run(fit, hull, steps) is hull and not steps.facts


def test_what_is_apart_does_not_grow(ball):
    up, wide, apart = cap(ball, [0, 0, 1], 0.1), cap(ball, [0, 0, 1], 0.2), cap(ball, [0, 0, -1], 0.1)
    np.testing.assert_array_equal(grown(wide | apart, up, ball.faces), wide & ~up)
    assert not grown(up, up, ball.faces).any()
