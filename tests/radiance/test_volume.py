"""The radiance volume: it learns, goes on where it stopped, and its surface has what no silhouette shows."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bowl import RADIUS

from gshell_mi.fields.mask_distances import MaskDistances
from gshell_mi.fields.visual_hull import visual_hull
from gshell_mi.fit.stages.volume import VolumeConfig
from gshell_mi.fit.volume.volume_surface import volume_surface
from gshell_mi.lattice import make_lattice
from gshell_mi.optimizer_arrays import optimizer_arrays, restore_optimizer
from gshell_mi.pixels import PixelPool
from gshell_mi.radiance.volume import RadianceVolume, sides_of_levels
from gshell_mi.scene import FitScene, load_fit_scene
from gshell_mi.topology import topology
from gshell_mi.views import PinholeViews

CONFIG = VolumeConfig(iterations=90, side=48, batch=16384)


@pytest.fixture(scope="module")
def scene(bowl_scene) -> FitScene:
    return load_fit_scene(bowl_scene)


def _volume(scene: FitScene, config: VolumeConfig = CONFIG, stored=None) -> RadianceVolume:
    views = PinholeViews.from_sensors(scene.sensors)
    sides = sides_of_levels(config.side, 3)
    side = sides[0]
    centre = (np.arange(side, dtype=np.float32) + 0.5) * (2 / side) - 1
    z, y, x = (axis.ravel() for axis in np.meshgrid(centre, centre, centre, indexing="ij"))
    alphas = [target.rgba[..., 3] for target in scene.targets]
    hull = visual_hull(mi.Point3f(x, y, z), MaskDistances(views, alphas)).numpy().reshape((side,) * 3)
    surface = np.zeros((1, 3), np.float32), np.zeros((0, 3), np.uint32)
    return RadianceVolume(
        np.clip(hull, -1, 1),
        scene.subject.to_world,
        views,
        PixelPool(views, scene.targets),
        config,
        sides,
        surface,
        stored,
    )


@pytest.fixture(scope="module")
def trained(scene) -> RadianceVolume:
    volume = _volume(scene)
    volume.losses = [volume.step(iteration) for iteration in range(CONFIG.iterations)]
    return volume


def test_it_learns_from_coarse_to_fine(trained):
    losses = [step["image"] for step in trained.losses]
    assert np.mean(losses[-10:]) < 0.4 * np.mean(losses[:10])
    assert trained.bricks.side == CONFIG.side
    assert trained.bricks.voxel_count < 0.5 * CONFIG.side**3, "empty space has no voxels"


def test_its_depth_is_that_of_the_bowl(scene, trained):
    """Also inside, which no silhouette shows."""
    errors = []
    for view, depth in enumerate(trained.depths()):
        ray, depth = trained.views.pixel_rays(view), depth.ravel()
        points = np.array(ray.o).T + depth[:, None] * np.array(ray.d).T
        seen = np.isfinite(depth) & (scene.targets[view].rgba[..., 3].ravel() > 0.99)
        errors.append(np.abs(np.linalg.norm(points[seen], axis=1) - RADIUS))
    assert np.median(np.concatenate(errors)) < 1.5 * 2 / CONFIG.side


def test_nothing_is_seen_from_within_what_is_opaque(scene):
    volume = _volume(scene)
    count = volume.bricks.voxel_count
    volume.optimizers["volume"]["density"] = dr.full(mi.Float, 100, count)
    inside, outside = mi.Point3f(0, -0.3, 0), mi.Point3f(0, 0.95, 0)
    assert volume.views_seeing(inside)[0] == 0 and volume.opacity_at(inside, 0.1)[0] == pytest.approx(1)
    assert volume.views_seeing(outside)[0] > 0 and volume.opacity_at(outside, 0.1)[0] == 0


def test_opacity_is_that_of_a_length(scene):
    volume = _volume(scene)
    assert -np.log1p(-volume.opacity_at(mi.Point3f(0, -0.3, 0), 0.1)[0]) == pytest.approx(
        0.13 * 0.1 * volume.bricks.side / 2, rel=1e-3
    )


def test_its_surface_is_around_the_bowl(scene, trained):
    """Wide enough for the lattice, and no wider; what it shows is what is seen there."""
    lattice = make_lattice("cube", 32)
    masks = MaskDistances(trained.views, [target.most_alpha for target in scene.targets])
    found = volume_surface(trained, scene, masks, lattice, np.float32(1))
    vertices, faces, _ = scene.subject.surface_of(found.fields).to_numpy()
    assert topology(vertices, faces).components == 1 and topology(vertices, faces).boundary_loops == 0
    below = vertices[vertices[:, 1] < -0.1]
    assert np.percentile(np.abs(np.linalg.norm(below, axis=1) - RADIUS), 80) < 2 / 32
    assert found.seen.known.any() and found.seen.radiance[found.seen.known].max() > 0.05


@pytest.mark.parametrize("direction_lr", [0.03, 0.0])
def test_it_goes_on_where_it_stopped(scene, direction_lr):
    config = dataclasses.replace(CONFIG, iterations=20, direction_lr=direction_lr)
    whole, first = _volume(scene, config), _volume(scene, config)
    for iteration in range(20):
        whole.step(iteration)
    for iteration in range(14):
        first.step(iteration)
    stored = first.arrays() | optimizer_arrays("volume", first.optimizers["volume"])
    second = _volume(scene, config, stored)
    restore_optimizer("volume", second.optimizers["volume"], stored)
    assert second.level == first.level == 2
    for iteration in range(14, 20):
        second.step(iteration)
    assert (second.bricks.places == whole.bricks.places).all()
    assert ("direction" in whole.optimizers["volume"].keys()) == (direction_lr > 0)
    for name in whole.optimizers["volume"].keys():
        one, other = (volume.optimizers["volume"][name].numpy() for volume in (whole, second))
        assert np.median(np.abs(one - other)) < 1e-3 * np.abs(one).max()
