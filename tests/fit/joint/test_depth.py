"""Depth maps: what they hold, and that the surface goes where they say."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bowl import CLOSED, RADIUS, SHORT, SIZE

from gshell_mi import UserError
from gshell_mi.fields import LatticeFields
from gshell_mi.fit import FitConfig
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.joint.depth import check_depth, depth_error
from gshell_mi.fit.joint.joint import JointStage
from gshell_mi.material import MaterialField
from gshell_mi.scene import load_fit_scene
from gshell_mi.targets import load_depth, load_target
from gshell_mi.views import PinholeViews


def sphere_distance(views: PinholeViews, index: int, radius: float = RADIUS) -> np.ndarray:
    """Distance to a sphere about the origin along the rays of a view; 0 where they miss it."""
    ray = views.pixel_rays(index)
    b, c = dr.dot(ray.o, ray.d), dr.squared_norm(ray.o) - radius**2
    discriminant = dr.square(b) - c
    distance = dr.select(discriminant > 0, -b - dr.sqrt(dr.maximum(discriminant, 0)), 0)
    return distance.numpy().reshape(SIZE, SIZE)


@pytest.fixture
def scene(bowl_scene, tmp_path) -> Path:
    """A copy of the bowl's scene with depth maps of the sphere beside the last six views, which look up."""
    shutil.copytree(bowl_scene.parent, tmp_path / "in")
    path = tmp_path / "in" / bowl_scene.name
    fit = load_fit_scene(path)
    views = PinholeViews.from_sensors(fit.sensors)
    for index, target in enumerate(fit.targets[6:], start=6):
        write(target.path.with_suffix(".depth.exr"), sphere_distance(views, index))
    return path


def write(path: Path, distance: np.ndarray) -> None:
    mi.Bitmap(np.ascontiguousarray(distance, np.float32)).write(str(path))


def test_maps_are_read_beside_the_targets(scene):
    fit = load_fit_scene(scene)
    assert [target.depth is not None for target in fit.targets] == [False] * 6 + [True] * 6
    views = PinholeViews.from_sensors(fit.sensors)
    found = fit.targets[8].depth
    np.testing.assert_allclose(found, sphere_distance(views, 8))
    corner, middle = found[0, 0], found[SIZE // 2, SIZE // 2]
    assert corner == 0 and middle == pytest.approx(3 - RADIUS, abs=1e-3)


def test_distance_is_along_the_ray(scene):
    """On a sphere about the camera every pixel has the same distance, and not the same z."""
    views = PinholeViews.from_sensors(load_fit_scene(scene).sensors)
    ray = views.pixel_rays(0)
    along, depth = ray(2.0), views.project(0, ray(2.0))[1]
    np.testing.assert_allclose(dr.norm(along - ray.o).numpy(), 2, rtol=1e-5)
    assert np.ptp(depth.numpy()) > 0.05


@pytest.mark.parametrize("unknown", [0.0, np.inf, np.nan])
def test_unknown_distances(tmp_path, unknown):
    distance = np.full((4, 6), 2.5)
    distance[1, 2] = unknown
    write(tmp_path / "a.depth.exr", distance)
    found = load_depth(tmp_path / "a.depth.exr", 6, 4)
    assert found[1, 2] == 0 and (np.delete(found.ravel(), 8) == 2.5).all()


def test_equal_channels_are_one(tmp_path):
    write(tmp_path / "a.depth.exr", np.full((4, 6, 3), 2.5))
    assert load_depth(tmp_path / "a.depth.exr", 6, 4).shape == (4, 6)


@pytest.mark.parametrize(
    ("pixels", "told"),
    [
        (np.full((4, 5), 2.0), "is 5 x 4 pixels, but its sensor's film is 6 x 4"),
        (np.full((4, 6), -2.0), "negative distances"),
        (np.zeros((4, 6)), "holds no distance"),
        (np.arange(72).reshape(4, 6, 3), "3 different channels"),
    ],
)
def test_mistakes(tmp_path, pixels, told):
    write(tmp_path / "a.depth.exr", pixels)
    with pytest.raises(UserError, match=told):
        load_depth(tmp_path / "a.depth.exr", 6, 4)


def test_no_image(tmp_path):
    mi.Bitmap(np.ones((4, 6, 4), np.float32)).write(str(tmp_path / "a.exr"))
    (tmp_path / "a.depth.exr").write_text("2.5")
    with pytest.raises(UserError, match=r"Depth map .*a.depth.exr' cannot be read"):
        load_target(tmp_path / "a.exr", 6, 4)


def test_millimetres_in_a_scene_of_metres(scene):
    fit = load_fit_scene(scene)
    views = PinholeViews.from_sensors(fit.sensors)
    check_depth(fit, views)
    targets = list(fit.targets)
    targets[9] = replace(targets[9], depth=1e3 * targets[9].depth)
    with pytest.raises(UserError, match=r"view_009.depth.exr' has distances from .* write distances in"):
        check_depth(replace(fit, targets=targets), views)


def stage(fit, radius: float, settings: dict | None = None) -> JointStage:
    lattice = fit.subject.lattice
    points = lattice.vertex_positions()
    fit.subject.set_fields(LatticeFields.closed(np.linalg.norm(points, axis=1) - radius))
    material = MaterialField(np.full((lattice.vertex_count, 3), 0.5))
    none = dict.fromkeys(("losses.mask", "losses.material_smoothness", "losses.light_grey"), 0.0)
    return JointStage(fit, material, None, FitConfig().changed(none | (settings or {})))


def test_the_loss_is_the_difference_in_cells(scene):
    """A sphere too small by half a cell, 0.05; along the rays that is 0.05 / cos, in the median 0.07."""
    fit = load_fit_scene(scene)
    joint = stage(fit, RADIUS - 0.05)
    joint.apply(geometry=True)
    _, terms = joint._regularisers([8])
    assert terms["depth"][0] == pytest.approx(0.5, abs=0.05)
    without = joint._regularisers([2])[1]["depth"]
    assert without[0] == 0, "a view without a map"
    error = depth_error(fit, PinholeViews.from_sensors(fit.sensors), joint.scene)
    assert error == pytest.approx(0.05 * 2**0.5, abs=0.005)


def test_what_is_unknown_has_no_depth(scene):
    fit = load_fit_scene(scene)
    views = PinholeViews.from_sensors(fit.sensors)
    targets = [target.ignoring(np.ones(target.rgba.shape[:2], bool)) for target in fit.targets]
    fit = replace(fit, targets=targets)
    joint = stage(fit, RADIUS - 0.05)
    joint.apply(geometry=True)
    assert joint._regularisers([8])[1]["depth"][0] == 0
    assert depth_error(fit, views, joint.scene) is None


def test_the_derivative_moves_the_surface_towards_the_map(scene):
    """A mean of differences in cells falls by 1 / 0.1 per unit of radius."""
    fit = load_fit_scene(scene)

    joint = stage(fit, RADIUS - 0.05)
    joint.apply(geometry=True)
    dr.backward(joint._regularisers([8])[1]["depth"])
    assert -dr.sum(dr.grad(joint.fields["sdf"]))[0] == pytest.approx(-10, rel=0.03)


def test_depth_is_measured_at_the_end(scene, tmp_path):
    output = tmp_path / "out"
    options = [*SHORT, *CLOSED, "--iterations", "1"]
    assert main([str(scene), "-o", str(output), "--quiet", *options]) == 0
    metrics = json.loads((output / "metrics.json").read_text())
    assert 0 < metrics["depth_error"] < 0.1
    steps = [json.loads(line) for line in (output / "log.jsonl").read_text().splitlines()]
    assert "depth" in next(step for step in steps if step["stage"] == "joint")
    assert set(metrics["diagnostics"]) >= {"pieces", "floaters", "pinholes", "self_contact", "unobserved"}
    assert isinstance(metrics["warnings"], list)
