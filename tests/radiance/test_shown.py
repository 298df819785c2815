"""Parts of a mesh look like meshes that are cut out of it."""

import numpy as np
import pytest
from cap import cap

from gshell_mi.fit.judge import Judge
from gshell_mi.scene import load_fit_scene
from gshell_mi.triangles import positive_part
from gshell_mi.views import PinholeViews


@pytest.fixture(scope="module")
def judge(bowl_scene):
    scene = load_fit_scene(bowl_scene)
    views = PinholeViews.from_sensors(scene.sensors)
    return Judge(views, scene.targets, Judge.halves(len(views)), batch=16384)


@pytest.fixture(scope="module")
def template(ball):
    """As large as the bowl, whose lower half it is."""
    return 0.7 * ball.vertices, ball.faces


@pytest.fixture(scope="module")
def closed(judge, template):
    return judge.shown(template)


def _values(ball, *directions):
    """Negative in caps around some directions, by the distance from their rims."""
    return np.min(
        [np.arccos(np.clip(ball.vertices @ np.array(direction), -1, 1)) - 0.6 for direction in directions],
        axis=0,
    )


def test_rays_meet_a_part_where_they_meet_its_mesh(ball, judge, template, closed):
    """Through one opening and out of another one, too."""
    values = _values(ball, [0, 1, 0], [0, -1, 0], [1, 0, 0])
    part, mesh = closed.part(values), judge.shown(positive_part(*template, values), like=closed)
    for split, rays in enumerate(closed.judging):
        radiance, alpha = (value.numpy() for value in part.look(rays.pixel, split, rays.met))
        expected, covered = (value.numpy() for value in mesh.whole.look(rays.pixel, split))
        assert (alpha != covered).mean() < 1e-3 and 0.02 < (covered == 0).mean() < 0.5
        both = (alpha > 0) & (covered > 0)
        error = np.abs(radiance - expected)[:, both]
        assert np.median(error) < 0.01 * expected[:, both].mean()
        assert error.mean() < 0.05 * expected[:, both].mean()


def test_a_part_is_judged_as_its_mesh_is(ball, judge, template, closed):
    up, side = cap(ball, [0, 1, 0], 0.3), cap(ball, [1, 0, 0], 0.1)
    place = np.where(up, 0, np.where(side, 1, -1))
    values = _values(ball, [0, 1, 0])
    quick = judge.compare(closed.whole, closed.part(values), place)
    mesh = judge.shown(positive_part(*template, values), like=closed)
    exact = judge.compare(closed.whole, mesh.whole, place)
    np.testing.assert_allclose(quick.gain, exact.gain, atol=0.1 * exact.noise.max())
    np.testing.assert_allclose(quick.noise, exact.noise, atol=0.1 * exact.noise.max())
    np.testing.assert_allclose(quick.before, exact.before, rtol=0.02)


def test_what_is_the_same_is_judged_the_same(ball, judge, closed):
    verdict = judge.compare(
        closed.whole, closed.part(np.ones(len(ball.vertices))), np.zeros(len(ball.vertices), int)
    )
    assert verdict.gain == pytest.approx(0, abs=1e-5) and not verdict.accepted


def test_nothing_left_shows_nothing(ball, closed):
    rays = closed.judging[0]
    radiance, alpha = closed.part(-np.ones(len(ball.vertices))).look(rays.pixel, 0, rays.met)
    assert not alpha.numpy().any() and not radiance.numpy().any()


def test_rays_that_meet_nothing_tell_nothing(ball, judge, template):
    """The template is behind all cameras."""
    away = judge.shown((template[0] + 100, template[1]))
    verdict = judge.compare(away.whole, away.whole, np.zeros(len(ball.vertices), int))
    assert np.isinf(verdict.noise).all()


def test_a_mesh_without_faces_shows_nothing(judge, closed):
    nothing = judge.shown((np.zeros((0, 3)), np.zeros((0, 3), int)), like=closed)
    _, alpha = nothing.whole.look(closed.judging[0].pixel, 0)
    assert not alpha.numpy().any()
