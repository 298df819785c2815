"""What views see of the places of a bowl."""

import dataclasses

import numpy as np
import pytest
from bowl import RADIUS, half_sphere

from gshell_mi.calibration.observations import observe
from gshell_mi.pixels import COVERED
from gshell_mi.scene import load_fit_scene
from gshell_mi.views import PinholeViews

CELL = 0.08


@pytest.fixture(scope="module")
def scene(bowl_scene):
    return load_fit_scene(bowl_scene)


@pytest.fixture(scope="module")
def bowl():
    mesh = half_sphere(48)
    return np.array(mesh.vertices), np.array(mesh.faces)


def look(scene, mesh, targets=None):
    views = PinholeViews.from_sensors(scene.sensors)
    return observe(mesh, views, targets or scene.targets, places=300, cell=CELL)


def test_places_are_seen_from_where_they_face(scene, bowl):
    seen = look(scene, bowl)
    assert len(seen) > 500 and len(np.unique(seen.view)) == len(scene.sensors)
    # Even numbers are the outside: an octahedron of views has some below, which see no inside.
    origins = PinholeViews.from_sensors(scene.sensors).origins
    below = np.flatnonzero(origins[:, 1] < -0.5 * np.linalg.norm(origins, axis=1))
    assert (seen.place[np.isin(seen.view, below)] % 2 == 0).all()
    above = np.argmax(origins[:, 1])
    assert (seen.place[seen.view == above] % 2 == 1).mean() > 0.5


def test_colours_are_those_of_the_print(scene, bowl):
    """What is printed, under light from everywhere, but for what is averaged over its edges."""
    seen = look(scene, bowl)
    outside = seen.log_radiance[seen.place % 2 == 0, 0]
    assert np.exp(np.percentile(outside, 99)) == pytest.approx(0.7, abs=0.04)
    assert 0.15 < np.exp(np.percentile(outside, 1)) < 0.3


def test_places_beside_outlines_and_of_what_is_unknown_are_left_out(scene, bowl):
    everything = look(scene, bowl)
    half = np.zeros_like(scene.targets[0].known)
    half[:, : half.shape[1] // 2] = 1
    targets = [dataclasses.replace(target, known=half) for target in scene.targets]
    assert 0.2 < len(look(scene, bowl, targets)) / len(everything) < 0.6
    shrunk = [
        dataclasses.replace(target, rgba=np.where(target.rgba[..., 3:] < COVERED, 0, target.rgba))
        for target in scene.targets
    ]
    assert len(look(scene, bowl, shrunk)) == len(everything)


def test_what_a_photograph_clips_is_left_out(scene, bowl):
    bright = [
        dataclasses.replace(target, rgba=target.rgba * np.float32([2, 2, 2, 1])) for target in scene.targets
    ]
    clipped = [dataclasses.replace(target, rgba=np.minimum(target.rgba, 1)) for target in bright]
    seen = look(scene, bowl, clipped)
    assert len(seen) < 0.7 * len(look(scene, bowl, bright))
    assert seen.log_radiance.max() < np.log(0.98)


def test_a_light_that_turns_with_the_camera_has_its_own_directions(scene, bowl):
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    turns = np.tile(turn, (len(scene.sensors), 1, 1))
    views = dataclasses.replace(PinholeViews.from_sensors(scene.sensors), turns=turns)
    still = look(scene, bowl)
    turned = observe(bowl, views, scene.targets, places=300, cell=CELL)
    for name in ("normal", "mirrored", "toward"):
        vectors = getattr(still, name)
        np.testing.assert_allclose(getattr(turned, name), vectors @ turns[0])
        assert np.allclose(np.linalg.norm(vectors, axis=1), 1)
    # What is mirrored lies on the other side of the normal.
    np.testing.assert_allclose((still.mirrored * still.normal).sum(1), (still.toward * still.normal).sum(1))


def test_what_hides_a_place(scene, bowl):
    """A plate under the bowl's mouth hides the bottom from above, and is seen itself."""
    vertices, faces = bowl
    y = -0.3 * RADIUS
    corners = np.array([[-1, y, -1], [1, y, -1], [1, y, 1], [-1, y, 1]]) * [0.5, 1, 0.5]
    both = (
        np.concatenate([vertices, corners]),
        np.concatenate([faces, np.array([[0, 2, 1], [0, 3, 2]]) + len(vertices)]),
    )
    views = PinholeViews.from_sensors(scene.sensors)
    seen = observe(both, views, scene.targets, places=10**6, cell=CELL)
    above = int(np.argmax(views.origins[:, 1]))
    bottom = np.flatnonzero(np.linalg.norm(vertices[:, [0, 2]], axis=1) < 0.3)
    assert not np.isin(seen.place[seen.view == above] // 2, bottom).any()
    alone = observe(bowl, views, scene.targets, places=10**6, cell=CELL)
    assert np.isin(alone.place[alone.view == above] // 2, bottom).any()
