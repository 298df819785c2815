"""Photometric refinement on a textured sphere: a start that is too large shrinks onto it."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from gshell_mi.fields.mask_distances import MaskDistances
from gshell_mi.fit.judge import Judge
from gshell_mi.fit.refinement.refinement import PhotometricRefinement, _barycentric
from gshell_mi.fit.stages.refinement import RefinementConfig
from gshell_mi.pixels import PixelPool
from gshell_mi.radiance.layers import Layer
from gshell_mi.radiance.surface_radiance import RadianceConfig, SurfaceRadiance
from gshell_mi.targets import Target
from gshell_mi.template.outlines import Outlines
from gshell_mi.views import PinholeViews

RADIUS, SIZE = 0.5, 48
RADIANCE = RadianceConfig(batch=8192, smoothing=1.0)
CONFIG = RefinementConfig(iterations=60, smoothing=6.3, detail=1.6, lr=0.3)
CELL = 2 / 32


def cameras() -> list[mi.Sensor]:
    directions = trimesh.creation.icosphere(subdivisions=1).vertices[::2]
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
        for d in directions
    ]


def pattern(point: mi.Point3f) -> mi.Color3f:
    """A radiance that varies within a quarter of the sphere, the same from everywhere."""
    return mi.Color3f(*(1 + dr.sin(5 * point[i] + i) for i in range(3)))


@pytest.fixture(scope="module")
def capture() -> tuple[PinholeViews, PixelPool, list[Target]]:
    """A sphere of RADIUS with ``pattern`` as its radiance, seen from all around."""
    views = PinholeViews.from_sensors(cameras())
    targets = []
    for index in range(len(views)):
        # 8 x 8 samples per pixel
        n = 8 * SIZE
        lane = dr.arange(mi.UInt32, n * n)
        film = mi.Point2f((lane % n + 0.5) / n, (lane // n + 0.5) / n)
        ray = views.rays(dr.full(mi.UInt32, index, n * n), film)
        half = dr.dot(ray.o, ray.d)
        root = dr.square(half) - dr.squared_norm(ray.o) + RADIUS**2
        color = dr.select(root > 0, pattern(ray(-half - dr.sqrt(dr.maximum(root, 0)))), 0)
        samples = np.concatenate([color.numpy(), (root > 0).numpy()[None]]).reshape(4, SIZE, 8, SIZE, 8)
        rgba = np.ascontiguousarray(samples.mean(axis=(2, 4)).transpose(1, 2, 0).astype(np.float32))
        targets.append(Target(None, rgba, True))
    return views, PixelPool(views, targets), targets


def masks_of(views, targets) -> MaskDistances:
    return MaskDistances(views, [target.most_alpha for target in targets])


def refinement(capture, vertices, faces, with_outlines) -> PhotometricRefinement:
    views, pixels, targets = capture
    solid = np.ones(len(vertices), bool)
    appearance = SurfaceRadiance(vertices, faces, views, pixels, RADIANCE)
    appearance.refit(solid)
    outlines = Outlines(masks_of(views, targets), targets, faces, solid) if with_outlines else None
    return PhotometricRefinement(appearance, vertices, faces, outlines, CELL, CONFIG)


def dented() -> tuple[np.ndarray, np.ndarray]:
    """The sphere with a bump that stands out by a cell, which no outline needs to show."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    vertices = np.array(mesh.vertices)
    bump = np.exp(-((np.linalg.norm(vertices - [RADIUS, 0, 0], axis=1) / 0.2) ** 2))
    return vertices * (1 + CELL / RADIUS * bump[:, None]), np.array(mesh.faces)


def test_bump_goes_down_without_outlines(capture):
    vertices, faces = dented()
    before = np.linalg.norm(vertices, axis=1) - RADIUS
    fit = refinement(capture, vertices, faces, with_outlines=False)
    first = fit.step(0)["image"]
    for step in range(1, CONFIG.iterations):
        last = fit.step(step)["image"]
    after = np.linalg.norm(fit.positions(), axis=1) - RADIUS
    high = before > 0.5 * CELL
    assert last < first
    assert np.abs(after[high]).mean() < 0.5 * before[high].mean()
    assert np.abs(after[~high]).mean() < 0.35 * CELL


def test_outline_of_the_true_sphere_is_the_masks(capture):
    views, _, targets = capture
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    faces = np.array(mesh.faces)
    pixel = 3 * np.linalg.norm(views.bases[0][:, 0]) / SIZE

    def distance(scale: float) -> float:
        vertices = scale * np.array(mesh.vertices)
        appearance = SurfaceRadiance(vertices, faces, views, capture[1], RADIANCE)
        outlines = Outlines(masks_of(views, targets), targets, faces, np.ones(len(vertices), bool))
        loss = outlines.loss(mi.Float(vertices.ravel()), appearance.scene, np.arange(len(views)))
        return float(np.sqrt(loss[0])) / pixel

    assert distance(1.0) < 0.2
    # A sphere that is larger by 2 pixels (the perspective makes it a little more on the film).
    assert distance(1 + 2 * pixel / RADIUS) == pytest.approx(2.0, rel=0.1)


def test_outlines_of_what_is_unknown_are_none(capture):
    views, pixels, targets = capture
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    appearance = SurfaceRadiance(vertices, faces, views, pixels, RADIANCE)
    cut, ignored = [], []
    for target in targets:
        rgba, known = target.rgba.copy(), np.ones(target.rgba.shape[:2], np.float32)
        # What stands before the sphere hides its edge, by some pixels.
        rgba[SIZE // 2 + SIZE // 10 :], known[SIZE // 2 + SIZE // 10 :] = 0, 0
        cut.append(Target(None, rgba, True))
        ignored.append(Target(None, rgba, True, known=known))
    losses = [
        float(
            np.sqrt(
                Outlines(masks_of(views, each), each, faces, np.ones(len(vertices), bool)).loss(
                    mi.Float(vertices.ravel()), appearance.scene, np.arange(len(views))
                )[0]
            )
        )
        for each in (cut, ignored)
    ]
    pixel = 3 * np.linalg.norm(views.bases[0][:, 0]) / SIZE
    assert losses[0] > 0.5 * pixel and losses[1] < 0.3 * pixel


def test_outline_loss_derivative_is_that_of_a_scaled_sphere(capture):
    views, pixels, targets = capture
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=1.05 * RADIUS)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    outlines = Outlines(masks_of(views, targets), targets, faces, np.ones(len(vertices), bool))
    appearance = SurfaceRadiance(vertices, faces, views, pixels, RADIANCE)
    every = np.arange(len(views))

    def loss(scale):
        return outlines.loss(mi.Float(vertices.ravel()) * scale, appearance.scene, every)

    scale = mi.Float(1)
    dr.enable_grad(scale)
    dr.backward(loss(scale))
    step = 1e-3
    numeric = (loss(mi.Float(1 + step))[0] - loss(mi.Float(1 - step))[0]) / (2 * step)
    assert dr.grad(scale)[0] == pytest.approx(numeric, rel=0.05)


def test_attached_barycentrics():
    positions = mi.Float([0, 0, 0, 1, 0, 0, 0, 1, 0])
    hit = Layer(
        mi.UInt32(0),
        mi.Point3f(0.25, 0.5, 1),
        mi.Vector3f(0, 0, -1),
        mi.Vector3u(0, 1, 2),
        mi.Vector3f(0.25, 0.25, 0.5),
        mi.Bool(True),
    )
    dr.enable_grad(positions)
    weights = _barycentric(positions, hit)
    assert np.allclose(dr.detach(weights).numpy().ravel(), [0.25, 0.25, 0.5])
    dr.backward(weights.y)  # x over the length of the first edge
    # Moving the corner at the origin along x by h: u = (0.25 - 0.5 h ...) by hand, du/dx0 = u - 1 + v.
    assert np.allclose(dr.grad(positions).numpy(), [-0.25, 0, 0, -0.25, 0, 0, -0.5, 0, 0], atol=1e-6)


def test_views_it_did_not_see_judge_the_refinement(capture):
    """The bump is worse on other views than the sphere."""
    views, _, targets = capture
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    vertices, faces = np.array(sphere.vertices), np.array(sphere.faces)
    vertices = np.where(vertices[:, 2:] > 0, 0.85, 1.0) * vertices
    seen, unseen = np.arange(len(views)) % 3 > 0, np.arange(len(views)) % 3 == 0
    judge = Judge(views, targets, [(np.flatnonzero(seen), np.flatnonzero(unseen))], batch=RADIANCE.batch)
    better = judge.decide((vertices, faces), (np.array(sphere.vertices), faces))
    assert better.accepted[0]
    assert not judge.decide((np.array(sphere.vertices), faces), (vertices, faces)).accepted[0]


def test_one_vertex_holds_up_no_others(capture):
    """Far from a vertex whose derivative is thousands of times the others', these move as far as without."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    far = vertices[:, 0] < 0
    moved = []
    for outlier in (1.0, 1e4, np.inf):
        round_ = refinement(capture, vertices, faces, False)
        gradient = vertices.astype(np.float32).copy()
        gradient[vertices[:, 0].argmax(), 0] = RADIUS * outlier
        dr.enable_grad(round_.optimizer["positions"])
        dr.set_grad(round_.optimizer["positions"], mi.Float(gradient.ravel()))
        round_._move(0.0, 0)
        moved.append(np.linalg.norm(round_.positions() - vertices, axis=1)[far].mean())
    assert min(moved[1:]) > 0.6 * moved[0] > 0
