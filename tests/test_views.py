"""Pinhole geometry against Mitsuba's own sensors."""

import dataclasses

import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gshell_mi.views import PinholeViews

SENSORS = {
    "plain": {"type": "perspective", "fov": 40},
    "fov along y": {"type": "perspective", "fov": 50, "fov_axis": "y"},
    "principal point": {
        "type": "perspective",
        "fov": 35,
        "principal_point_offset_x": 0.1,
        "principal_point_offset_y": -0.2,
    },
    "thin lens": {"type": "thinlens", "fov": 40, "aperture_radius": 0.1, "focus_distance": 3.0},
}


def sensor(kind, crop):
    film = {"type": "hdrfilm", "width": 64, "height": 48}
    if crop:
        film |= {"crop_width": 20, "crop_height": 12, "crop_offset_x": 30, "crop_offset_y": 9}
    to_world = mi.ScalarTransform4f().look_at([1, 2, 3], [0.1, 0, 0], [0, 1, 0])
    return mi.load_dict(SENSORS[kind] | {"to_world": to_world, "film": film})


@pytest.mark.parametrize("crop", [False, True])
@pytest.mark.parametrize("kind", SENSORS)
def test_rays_are_those_of_the_sensor_and_projection_inverts_them(kind, crop):
    camera = sensor(kind, crop)
    views = PinholeViews.from_sensors([camera])
    film = mi.Point2f(np.random.default_rng(3).random((2, 100)).astype(np.float32))
    ray = views.rays(mi.UInt32([0] * 100), film)
    expected, _ = camera.sample_ray(0.0, 0.5, film, mi.Point2f(0.5))
    np.testing.assert_allclose(np.array(ray.d), np.array(expected.d), atol=1e-5)
    at, depth = views.project(0, ray(2.5))
    np.testing.assert_allclose(np.array(at), np.array(film), atol=1e-4)
    assert np.array(depth).min() > 0


def test_directions_in_surroundings_that_turn():
    sensors = [mi.load_dict({"type": "perspective"}) for _ in range(3)]
    views = PinholeViews.from_sensors(sensors)
    direction = mi.Vector3f([0.6, 0, 0], [0, 1, 0], [0.8, 0, 1])
    assert views.in_surroundings(mi.UInt32(0, 1, 2), direction) is direction
    turns = Rotation.random(3, random_state=0).as_matrix()
    turning = dataclasses.replace(views, turns=turns)
    found = turning.in_surroundings(mi.UInt32(2, 0, 1), direction).numpy()
    expected = np.einsum("ncr,cn->rn", turns[[2, 0, 1]], direction.numpy())
    np.testing.assert_allclose(found, expected, atol=1e-6)
