"""The judge of two surfaces: what is right is accepted and what is wrong rejected, also in noisy images."""

import dataclasses

import numpy as np
import pytest
import trimesh
from bowl import RADIUS, half_sphere
from scipy.spatial import Delaunay

from gshell_mi.fit.judge import Judge, Verdict, verdict_of
from gshell_mi.scene import load_fit_scene
from gshell_mi.views import PinholeViews


def _bowl() -> tuple[np.ndarray, np.ndarray]:
    mesh = half_sphere(64)
    return mesh.vertices, mesh.faces


def _with_lid() -> tuple[np.ndarray, np.ndarray]:
    """The bowl closed by a flat lid, which the masks do not tell from an opening."""
    bowl = half_sphere(64)
    angle = np.linspace(0, 2 * np.pi, 65)[:-1]
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    flat = RADIUS * np.concatenate([np.zeros((1, 2)), *(radius * circle for radius in (0.3, 0.6, 0.8, 1.0))])
    lid = trimesh.Trimesh(np.insert(flat, 1, 0, axis=1), Delaunay(flat).simplices)
    both = trimesh.util.concatenate(bowl, lid)
    return both.vertices, both.faces


@pytest.fixture(scope="module")
def scene(bowl_scene):
    return load_fit_scene(bowl_scene)


def _verdict(scene, before, after, spoil=lambda rgba: rgba) -> Verdict:
    """Of the rays that meet the lid: half of the views see nothing of it."""
    views = PinholeViews.from_sensors(scene.sensors)
    targets = [
        dataclasses.replace(target, rgba=spoil(target.rgba).astype(np.float32)) for target in scene.targets
    ]
    judge = Judge(views, targets, Judge.halves(len(views)), batch=16384)
    lid = np.arange(len(_with_lid()[0])) >= len(_bowl()[0])
    shown = [judge.shown(mesh).whole for mesh in (before, after)]
    return judge.compare(*shown, np.where(lid, 0, -1), judge.shown(_with_lid()))


def test_an_opening_that_is_there_is_accepted_and_a_lid_rejected(scene):
    opened, closed = _verdict(scene, _with_lid(), _bowl()), _verdict(scene, _bowl(), _with_lid())
    assert opened.accepted and opened.gain > 0
    assert not closed.accepted and closed.gain < 0
    assert opened.gain == pytest.approx(-closed.gain, rel=1e-3)


def test_nothing_is_gained_by_what_is_the_same(scene):
    same = _verdict(scene, _bowl(), _bowl())
    assert same.gain == pytest.approx(0, abs=1e-5) and not same.accepted


def test_noise_in_the_images_does_not_change_what_is_accepted(scene):
    rng = np.random.default_rng(0)

    def noisy(rgba: np.ndarray) -> np.ndarray:
        color = np.maximum(rgba[..., :3] + rng.normal(0, 0.05, rgba[..., :3].shape), 0) * rgba[..., 3:]
        return np.concatenate([color, rgba[..., 3:]], axis=-1)

    assert _verdict(scene, _with_lid(), _bowl(), noisy).accepted
    assert not _verdict(scene, _bowl(), _with_lid(), noisy).accepted


def test_each_place_is_judged_by_the_rays_that_meet_it_first(scene):
    """The lid is wrong; the bowl's wall is the same with and without it."""
    views = PinholeViews.from_sensors(scene.sensors)
    judge = Judge(views, scene.targets, Judge.halves(len(views)), batch=16384)
    closed, opened = _with_lid(), _bowl()
    lid = np.arange(len(closed[0])) >= len(opened[0])
    place = np.where(lid, 0, np.where(closed[0][:, 1] < -0.4 * RADIUS, 1, -1))
    lid_on = judge.shown(closed)
    verdict = judge.compare(lid_on.whole, judge.shown(opened).whole, place)
    assert verdict.accepted.tolist() == [True, False]
    assert verdict.after[0] < 0.85 * verdict.before[0]
    assert verdict.gain[1] == pytest.approx(0, abs=0.05)


def test_a_constant_residual_neither_passes_nor_blocks_a_change():
    rng = np.random.default_rng(1)
    rays, noise = np.full((1, 40), 100.0), rng.normal(0, 1, (1, 40))
    for residual in (0.1, 10.0):
        before = 100 * (residual + 0.5 + 0.02 * noise)
        assert verdict_of(rays, before, before - 50).accepted
        assert not verdict_of(rays, before, before + 2 * rng.normal(0, 1, (1, 40))).accepted


def test_few_views_are_not_enough():
    rays = np.zeros((1, 40))
    rays[:, :3] = 100
    assert not verdict_of(rays, 100.0 * (rays > 0), 10.0 * (rays > 0)).accepted


def _told(z: list[float], rejected: int = 0) -> list[bool]:
    gain = 0.1 * np.array(z)
    return Verdict(gain, gain, gain, np.full(len(z), 0.1), rejected=rejected).accepted.tolist()


def test_of_many_places_the_best_by_chance_is_not_accepted():
    rng = np.random.default_rng(0)
    chance = [sum(_told(rng.normal(size=24).tolist())) for _ in range(2000)]
    # Each of them has a chance of 2.3 % to be above two standard errors, 43 % that one of 24 is.
    assert np.mean(np.array(chance) > 0) == pytest.approx(0.0228, abs=0.01)


def test_what_was_rejected_before_counts():
    assert _told([2.1]) == [True]
    assert _told([2.1], rejected=23) == [False]
    assert _told([3.2], rejected=23) == [True]


@pytest.mark.parametrize("views", [4, 8, 48])
def test_few_views_do_not_accept_by_chance_more_often(views):
    """What changes nothing is accepted as often as a normal variate is above two."""
    count, rng = 20_000, np.random.default_rng(0)
    rays = np.full((count, views), 100.0)
    verdict = verdict_of(rays, 1000 * np.exp(0.1 * rng.normal(size=rays.shape)), np.full(rays.shape, 1000.0))
    assert verdict.views == pytest.approx(views)
    accepted = np.mean([verdict.at(slice(place, place + 1)).accepted[0] for place in range(count)])
    assert accepted == pytest.approx(0.0228, abs=0.004)


def test_many_places_that_are_all_better_are_all_accepted():
    assert all(_told([2.1] * 24))


def test_a_place_that_hardly_a_view_tells_of_makes_others_no_less_sure():
    gain, noise = np.array([0.21] + 30 * [0.0]), np.array([0.1] + 30 * [np.inf])
    assert Verdict(gain, gain, gain, noise).accepted.tolist() == [True] + 30 * [False]


def test_verdicts_together_are_one_family():
    def of(z: float) -> Verdict:
        return Verdict(*np.full((3, 1), 0.1 * z), np.full(1, 0.1))

    together = Verdict.together([of(2.1), *[of(0.0)] * 5])
    assert of(2.1).accepted.all() and not together.accepted.any()
    np.testing.assert_allclose(together.gain, [0.21, *[0] * 5])
