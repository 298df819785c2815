"""Compositing of layers in closed form, and its verdict on true and false openings."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from bowl import RADIUS, half_sphere

from gshell_mi.fit.stages.openings import OpacityTraining, OpeningsConfig
from gshell_mi.pixels import PixelPool
from gshell_mi.radiance.surface_radiance import RadianceConfig, SurfaceRadiance
from gshell_mi.scene import load_fit_scene
from gshell_mi.targets import Target
from gshell_mi.views import PinholeViews

CONFIG = RadianceConfig(batch=4096, smoothing=1.0)
TRAINING = OpeningsConfig(iterations=60)


def logit(x):
    return np.log(x / (1 - x))


def inverse_softplus(x):
    return np.log(np.expm1(x))


# --- two sheets, one behind the other


def two_sheets() -> tuple[np.ndarray, np.ndarray]:
    """Squares at z = 1 and z = 0 that face +z."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    nearer = square + np.array([0, 0, 1])
    return np.concatenate([nearer, square]), np.concatenate([faces, faces + 4])


def unused_views():
    sensor = mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "width": 2, "height": 2}})
    views = PinholeViews.from_sensors([sensor])
    return views, PixelPool(views, [Target(None, np.ones((2, 2, 4), np.float32), True)])


@pytest.fixture(scope="module")
def sheets() -> SurfaceRadiance:
    """Opacities 0.3 and 0.6, constant radiance of each side of each sheet."""
    appearance = SurfaceRadiance(*two_sheets(), *unused_views(), CONFIG)
    appearance.optimizer["opacity"] = mi.Float(np.repeat(logit(np.array([0.3, 0.6])), 4))
    both_sides = np.stack([FRONT, BACK], axis=1)
    appearance.optimizer["radiance"] = mi.Float(np.repeat(inverse_softplus(both_sides), 4, axis=0).ravel())
    return appearance


FRONT = np.array([[1.0, 0.5, 0.2], [0.1, 2.0, 0.4]])
BACK = np.array([[0.3, 0.3, 3.0], [0.7, 0.2, 0.6]])


def see(appearance, origin, direction):
    layers = appearance._layers(mi.Ray3f(origin, direction))
    return appearance.composite(layers, mi.UInt32(0))


def composite(appearance, origin, direction):
    radiance, alpha = see(appearance, origin, direction)
    return np.ravel(radiance), np.ravel(alpha)[0]


def test_over(sheets):
    radiance, alpha = composite(sheets, [0.1, 0.2, 5], [0, 0, -1])
    assert alpha == pytest.approx(1 - 0.7 * 0.4, abs=1e-5)
    np.testing.assert_allclose(radiance, 0.3 * FRONT[0] + 0.7 * 0.6 * FRONT[1], atol=1e-5)


def test_from_behind_the_back_sides_are_seen_in_reverse(sheets):
    radiance, alpha = composite(sheets, [0.1, 0.2, -5], [0, 0, 1])
    assert alpha == pytest.approx(1 - 0.7 * 0.4, abs=1e-5)
    np.testing.assert_allclose(radiance, 0.6 * BACK[1] + 0.4 * 0.3 * BACK[0], atol=1e-5)


def test_between_the_sheets(sheets):
    radiance, alpha = composite(sheets, [0.1, 0.2, 0.5], [0, 0, -1])
    assert alpha == pytest.approx(0.6, abs=1e-5)
    np.testing.assert_allclose(radiance, 0.6 * FRONT[1], atol=1e-5)


def test_a_miss_is_transparent(sheets):
    radiance, alpha = composite(sheets, [3, 0, 5], [0, 0, -1])
    assert alpha == 0 and not radiance.any()


def test_a_preview_is_of_its_triangles(sheets):
    preview = sheets.preview()
    np.testing.assert_array_equal(preview.template_faces, two_sheets()[1])
    np.testing.assert_allclose(preview.vertices, two_sheets()[0])


def test_what_no_ray_meets_keeps_its_radiance():
    vertices, faces = two_sheets()
    appearance = SurfaceRadiance(vertices - [0, 0, 5], faces, *unused_views(), CONFIG)
    before = appearance.radiance()
    appearance.refit(np.ones(len(vertices), bool))
    np.testing.assert_array_equal(appearance.radiance(), before)


def test_only_the_first_layers_count():
    appearance = SurfaceRadiance(*two_sheets(), *unused_views(), dataclasses.replace(CONFIG, layers=1))
    _, alpha = composite(appearance, [0.1, 0.2, 5], [0, 0, -1])
    assert alpha == pytest.approx(0.35, abs=1e-5), "where every vertex starts"


def test_derivatives_of_coverage(sheets):
    """d alpha / d logit_i = (1 - a_0) (1 - a_1) a_i, shared among the corners by their weights."""
    opacity = mi.Float(sheets.optimizer["opacity"])
    dr.enable_grad(opacity)
    old, sheets.optimizer["opacity"] = sheets.optimizer["opacity"], opacity
    _, alpha = see(sheets, [0.1, 0.2, 5], [0, 0, -1])
    dr.backward(alpha)
    gradient = dr.grad(sheets.optimizer["opacity"]).numpy().reshape(2, 4).sum(1)
    sheets.optimizer["opacity"] = dr.detach(old)
    np.testing.assert_allclose(gradient, 0.7 * 0.4 * np.array([0.3, 0.6]), atol=1e-5)


# --- the bowl under its lid


SEGMENTS = 64


def lidded_bowl() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The bowl closed by a flat lid: vertices, faces and the mask of the vertices within the lid."""
    bowl = half_sphere(SEGMENTS)
    rim = len(bowl.vertices) - SEGMENTS + np.arange(SEGMENTS)
    vertices, faces, ring = list(bowl.vertices), list(bowl.faces), rim
    for radius in (0.8, 0.6, 0.4, 0.2):
        inner = len(vertices) + np.arange(SEGMENTS)
        vertices += list(bowl.vertices[rim] * radius)
        for i in range(SEGMENTS):
            faces += [[ring[i - 1], inner[i - 1], inner[i]], [ring[i - 1], inner[i], ring[i]]]
        ring = inner
    faces += [[ring[i - 1], len(vertices), ring[i]] for i in range(SEGMENTS)]
    vertices.append(np.zeros(3))
    vertices, faces = np.array(vertices), np.array(faces)
    closed = trimesh.Trimesh(vertices, faces, process=False)
    assert closed.is_watertight and closed.volume > 0, "oriented outwards"
    lid = np.arange(len(vertices)) >= len(bowl.vertices)
    return vertices, faces, lid


def test_training_tells_the_lid_from_the_bowl(bowl_scene):
    fit = load_fit_scene(bowl_scene)
    views = PinholeViews.from_sensors(fit.sensors)
    vertices, faces, lid = lidded_bowl()
    appearance = SurfaceRadiance(vertices, faces, views, PixelPool(views, fit.targets), CONFIG)
    training = OpacityTraining(appearance, TRAINING)
    losses = [training.step(i)["image"] for i in range(TRAINING.iterations)]
    assert np.mean(losses[-10:]) < 0.65 * np.mean(losses[:10])
    logits = appearance.smoothed_logits()
    inner = lid & (np.linalg.norm(vertices, axis=1) < 0.7 * RADIUS)
    assert (logits[inner] < 0).all()
    assert np.median(logits[inner]) < np.median(logits[~lid]) - 0.3
