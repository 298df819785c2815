"""Corrections of cameras: sensors and views agree, and what all cameras have in common is none."""

import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gshell_mi.calibration.corrections import Corrections
from gshell_mi.views import PinholeViews


def sensor(index: int, kind: str = "perspective") -> mi.Sensor:
    rng = np.random.default_rng(index)
    origin = rng.normal(size=3)
    origin *= 3 / np.linalg.norm(origin)
    optics = (
        {"aperture_radius": 0.01, "focus_distance": 3.0}
        if kind == "thinlens"
        else {"principal_point_offset_x": 0.1, "principal_point_offset_y": -0.05}
    )
    return mi.load_dict(
        {
            "type": kind,
            "id": f"view_{index:03}",
            "fov": 35.0,
            "fov_axis": "y",
            **optics,
            "to_world": mi.ScalarTransform4f().look_at(origin.tolist(), [0, 0, 0], [0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": 60,
                "height": 40,
                "crop_width": 50,
                "crop_height": 30,
                "crop_offset_x": 3,
                "crop_offset_y": 7,
            },
        }
    )


def corrections(count: int, size: float = 0.02, seed: int = 1) -> Corrections:
    rng = np.random.default_rng(seed)
    return Corrections(size * rng.normal(size=(count, 3)), size * rng.normal(size=(count, 3)))


@pytest.mark.parametrize("kind", ["perspective", "thinlens"])
def test_sensors_are_where_the_views_are(kind):
    sensors, change = [sensor(index, kind) for index in range(3)], corrections(3)
    found = PinholeViews.from_sensors(change.sensors(sensors))
    expected = change.views(PinholeViews.from_sensors(sensors))
    assert found.ids == expected.ids and (found.sizes == expected.sizes).all()
    np.testing.assert_allclose(found.origins, expected.origins, atol=1e-6)
    np.testing.assert_allclose(found.bases, expected.bases, atol=1e-5)
    assert [one.film() for one in change.sensors(sensors)] == [one.film() for one in sensors]


def test_corrections_follow_each_other_and_are_taken_back():
    given = PinholeViews.from_sensors([sensor(index) for index in range(3)])
    first, then = corrections(3), corrections(3, seed=2)
    once, both = first.views(given), then.after(first).views(given)
    for found, expected in ((both, then.views(once)), (first.inverse().views(once), given)):
        np.testing.assert_allclose(found.origins, expected.origins, atol=1e-12)
        np.testing.assert_allclose(found.bases, expected.bases, atol=1e-12)


def test_only_what_is_in_an_image_moves_there():
    """A close-up has much behind it, and beside it."""
    given = PinholeViews.from_sensors([sensor(index) for index in range(2)])
    axis = given.bases[0] @ [0.5, 0.5, 1.0]
    ahead, behind = given.origins[0] + 3 * axis, given.origins[0] - 1e-6 * axis
    change = corrections(2, size=1e-3)
    alone = change.in_pixels(given, ahead[None])[0]
    assert 0 < alone < 1
    assert change.in_pixels(given, np.stack([ahead, behind]))[0] == alone
    assert change.in_pixels(given, behind[None])[0] == 0


def test_who_has_no_say_is_no_part_of_what_all_have_in_common():
    views = PinholeViews.from_sensors([sensor(index) for index in range(6)])
    change = Corrections(np.zeros((6, 3)), np.zeros((6, 3)))
    change.shifts[2], weight = 0.5, np.where(np.arange(6) == 2, 0.0, 1.0)
    np.testing.assert_allclose(change.as_given(views, weight).to_array(), change.to_array(), atol=1e-12)
    assert np.abs(change.as_given(views).to_array() - change.to_array()).max() > 0.01


def test_a_similarity_of_all_cameras_is_no_correction():
    views = PinholeViews.from_sensors([sensor(index) for index in range(6)])
    turn, middle = Rotation.from_rotvec([0.1, -0.2, 0.05]), views.origins.mean(axis=0)
    moved = 1.07 * turn.apply(views.origins - middle) + middle + [0.3, 0.1, -0.2]
    common = Corrections(np.tile(turn.as_rotvec(), (6, 1)), moved - views.origins)
    left = common.as_given(views)
    np.testing.assert_allclose(left.to_array(), 0, atol=1e-9)
    # Together with corrections of their own nothing else is left of it.
    own = corrections(6).as_given(views)
    both = Corrections(
        (turn * Rotation.from_rotvec(own.rotations)).as_rotvec(),
        1.07 * turn.apply(views.origins + own.shifts - middle) + middle - views.origins,
    )
    np.testing.assert_allclose(both.as_given(views).to_array(), own.to_array(), atol=1e-9)


def test_one_camera_stays_where_it_is():
    views = PinholeViews.from_sensors([sensor(0)])
    np.testing.assert_allclose(corrections(1).as_given(views).to_array(), 0, atol=1e-9)


def test_movement_in_pixels():
    """A camera that turns by a small angle moves the middle of its image by f times that."""
    to_world = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    views = PinholeViews.from_sensors(
        [
            mi.load_dict(
                {
                    "type": "perspective",
                    "fov": 40.0,
                    "to_world": to_world,
                    "film": {"type": "hdrfilm", "width": 200, "height": 200},
                }
            )
        ]
    )
    change = Corrections(np.array([[0, 1e-3, 0]]), np.zeros((1, 3)))
    focal = 100 / np.tan(np.radians(20))
    assert change.in_pixels(views, np.zeros((1, 3)))[0] == pytest.approx(1e-3 * focal, rel=1e-3)


def test_arrays():
    change = corrections(4)
    np.testing.assert_array_equal(Corrections.from_array(change.to_array()).shifts, change.shifts)
