"""What all of a surface mirrors: found again from rays, and no substitute for what places show."""

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from gshell_mi.fit.judge import Judge
from gshell_mi.fit.refinement.refinement import PhotometricRefinement
from gshell_mi.fit.stages.refinement import RefinementConfig
from gshell_mi.pixels import PixelPool
from gshell_mi.radiance.mirrored import Mirrored, mirrored_direction
from gshell_mi.radiance.shown import Shown
from gshell_mi.radiance.surface_radiance import RadianceConfig, SurfaceRadiance
from gshell_mi.targets import Target
from gshell_mi.triangles import positive_part
from gshell_mi.views import PinholeViews

_DEGREES = np.arange(1, 7)
COEFFICIENTS = 0.3 * np.random.default_rng(0).uniform(-1, 1, (3, 48)) / np.repeat(_DEGREES, 2 * _DEGREES + 1)


def _directions(count: int, seed: int) -> mi.Vector3f:
    return dr.normalize(mi.Vector3f(np.random.default_rng(seed).normal(size=(3, count)).astype(np.float32)))


def test_nothing_mirrored_is_the_factor_one():
    np.testing.assert_array_equal(Mirrored.nothing().factor(_directions(5, 0)).numpy(), 1)


def test_a_ray_is_mirrored_at_either_side():
    direction, normal = mi.Vector3f(0.6, -0.8, 0), mi.Vector3f(0, 3, 0)
    for side in normal, -normal:
        mirrored = mirrored_direction(direction, side).numpy().ravel()
        np.testing.assert_allclose(mirrored, [0.6, 0.8, 0], atol=1e-6)


def _views(count: int, seed: int) -> mi.UInt32:
    return mi.UInt32(np.random.default_rng(seed).integers(0, 20, count).astype(np.uint32))


def test_it_is_found_from_rays():
    truth, direction = Mirrored(COEFFICIENTS), _directions(20000, 1)
    color = mi.Color3f(np.random.default_rng(2).uniform(0.2, 0.8, (3, 20000)).astype(np.float32))
    found = Mirrored.nothing().improved(direction, color * truth.factor(direction), color, _views(20000, 5))
    np.testing.assert_allclose(found.coefficients, COEFFICIENTS, atol=2e-3)


def test_colors_that_do_not_depend_on_the_direction_mirror_nothing():
    rng = np.random.default_rng(3)
    color, noise = (
        mi.Color3f(rng.uniform(low, high, (3, 20000)).astype(np.float32))
        for low, high in ((0.2, 0.8), (0.9, 1.1))
    )
    found = Mirrored.nothing().improved(_directions(20000, 4), color * noise, color, _views(20000, 5))
    assert np.abs(found.coefficients).max() < 0.01


def test_what_one_view_tells_is_not_believed_of_others():
    """Each view is brighter or darker as a whole, and looks into directions of its own."""
    count, views, errors = 20000, 24, []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        view = rng.integers(0, views, count)
        middle = rng.normal(size=(3, views))
        middle /= np.linalg.norm(middle, axis=0)
        direction = (middle[:, view] + 0.1 * rng.normal(size=(3, count))).astype(np.float32)
        color = mi.Color3f(np.full((3, count), 0.5, np.float32))
        bright = (1 + 0.3 * rng.normal(size=views)).astype(np.float32)
        found = Mirrored.nothing().improved(
            dr.normalize(mi.Vector3f(direction)),
            color * mi.Float(bright[view]),
            color,
            mi.UInt32(view.astype(np.uint32)),
        )
        errors.append(np.sqrt(np.mean((found.factor(_directions(1000, 7)).numpy() - 1) ** 2)))
    assert np.mean(errors) < 0.1


# --- a glossy sphere: its highlights move over it as the camera does

RADIUS, SIZE = 0.5, 48
CELL = 2 / 32
RADIANCE = RadianceConfig(batch=8192, smoothing=1.0)
CONFIG = RefinementConfig(iterations=80, smoothing=6.3, detail=3.1, lr=0.2)


def cameras() -> list[mi.Sensor]:
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    look_at = mi.ScalarTransform4f().look_at
    return [
        mi.load_dict(
            {
                "type": "perspective",
                "fov": 35,
                "film": film,
                "to_world": look_at((3 * d).tolist(), [0, 0, 0], [0.1, 1, 0.2]),
            }
        )
        for d in trimesh.creation.icosphere(subdivisions=1).vertices
    ]


def glossy_sphere() -> tuple[PinholeViews, list[Target]]:
    """One grey, and the mirror image of a sky with a bright side."""
    views, targets = PinholeViews.from_sensors(cameras()), []
    for index in range(len(views)):
        lane = dr.arange(mi.UInt32, (4 * SIZE) ** 2)
        film = mi.Point2f((lane % (4 * SIZE) + 0.5) / (4 * SIZE), (lane // (4 * SIZE) + 0.5) / (4 * SIZE))
        ray = views.rays(dr.full(mi.UInt32, index, dr.width(lane)), film)
        half = dr.dot(ray.o, ray.d)
        root = dr.square(half) - dr.squared_norm(ray.o) + RADIUS**2
        normal = (ray(-half - dr.sqrt(dr.maximum(root, 0)))) / RADIUS
        mirrored = ray.d - 2 * dr.dot(ray.d, normal) * normal
        radiance = 0.3 + 0.5 * dr.exp(3 * (mirrored.x - 1)) + 0.3 * dr.exp(3 * (mirrored.y - 1))
        covered = root > 0
        gray = dr.select(covered, radiance, 0).numpy()
        samples = np.stack([gray, gray, gray, covered.numpy()]).reshape(4, SIZE, 4, SIZE, 4)
        rgba = np.ascontiguousarray(samples.mean(axis=(2, 4)).transpose(1, 2, 0).astype(np.float32))
        targets.append(Target(None, rgba, True))
    return views, targets


def test_highlights_pull_the_surface_inwards_far_less():
    views, targets = glossy_sphere()
    pixels = PixelPool(views, targets)
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    offsets = {}
    shown = Shown((vertices, faces), views, [(pixels, pixels)], batch=16384, seed=0)
    for known in (False, True):
        appearance = SurfaceRadiance(
            vertices, faces, views, pixels, RADIANCE, mirrored=shown.mirrored if known else None
        )
        for _ in range(3):
            appearance.refit(np.ones(len(vertices), bool))
        refinement = PhotometricRefinement(appearance, vertices, faces, None, CELL, CONFIG)
        for step in range(CONFIG.iterations):
            refinement.step(step)
        offsets[known] = (np.linalg.norm(refinement.positions(), axis=1) - RADIUS).mean() / CELL
    assert offsets[False] < -0.2
    assert abs(offsets[True]) < 0.4 * abs(offsets[False])


def test_the_judge_takes_no_polished_place_for_a_window():
    """The mirror image lies behind the surface, where the other side's back can show it."""
    views, targets = glossy_sphere()
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    window = vertices @ [1, 0, 0] > 0.75 * RADIUS
    judge = Judge(views, targets, Judge.halves(len(views)), batch=16384)
    opened = positive_part(vertices, faces, np.where(window, -1.0, 1.0))
    verdict = judge.compare(
        judge.shown((vertices, faces)).whole, judge.shown(opened).whole, np.where(window, 0, -1)
    )
    assert (verdict.gain < -2 * verdict.noise).tolist() == [True]
