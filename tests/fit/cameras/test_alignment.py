"""Cameras around a textured potato: found where they are wrong, left alone where they are right."""

import dataclasses
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from gshell_mi.calibration.corrections import Corrections
from gshell_mi.calibration.evidence import Outline, Texture
from gshell_mi.compat import mesh_scene
from gshell_mi.fit.cameras.alignment import Alignment
from gshell_mi.targets import Target
from gshell_mi.views import PinholeViews

VIEWS, SIZE, OVER, DISTANCE = 14, 128, 3, 3.0


def potato() -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(5)
    points = np.array(ball.vertices)
    bumps = 1 + 0.1 * np.sin(4 * points[:, 0] + 1) + 0.1 * np.cos(5 * points[:, 1] - 2 * points[:, 2])
    return points * bumps[:, None] * [0.7, 0.5, 0.6], np.array(ball.faces)


def texture(points: np.ndarray) -> np.ndarray:
    """(P,) reflectance with structure some pixels wide."""
    waves = np.random.default_rng(3).normal(0, 14, (24, 3))
    return 0.4 + 0.06 * np.cos(points @ waves.T + np.arange(24)).sum(axis=1)


@pytest.fixture(scope="module")
def mesh():
    return potato()


@pytest.fixture(scope="module")
def views() -> PinholeViews:
    rng, sensors = np.random.default_rng(0), []
    for index in range(VIEWS):
        origin = rng.normal(size=3)
        origin *= DISTANCE / np.linalg.norm(origin)
        sensors.append(
            mi.load_dict(
                {
                    "type": "perspective",
                    "id": f"view_{index:03}",
                    "fov": 32.0,
                    "to_world": mi.ScalarTransform4f().look_at(origin.tolist(), [0, 0, 0], [0, 1, 0.1]),
                    "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE},
                }
            )
        )
    return PinholeViews.from_sensors(sensors)


def photograph(mesh, views: PinholeViews, *, textured: bool = True) -> list[Target]:
    """What exact cameras see, antialiased."""
    scene, targets = mesh_scene(*mesh), []
    for view in range(len(views)):
        row, column = np.mgrid[: SIZE * OVER, : SIZE * OVER].reshape(2, -1)
        film = (np.stack([column, row]) + 0.5) / (SIZE * OVER)
        index = mi.UInt32(np.full(film.shape[1], view, np.uint32))
        ray = views.rays(index, mi.Point2f(film.astype(np.float32)))
        hit = scene.ray_intersect(ray)
        valid, points = hit.is_valid().numpy(), hit.p.numpy().T
        color = np.where(valid, texture(points) if textured else 0.4, 0)
        rgba = np.stack([color] * 3 + [valid.astype(float)], axis=1)
        rgba = rgba.reshape(SIZE, OVER, SIZE, OVER, 4).mean(axis=(1, 3)).astype(np.float32)
        targets.append(Target(Path(f"view_{view:03}.exr"), rgba, True))
    return targets


@pytest.fixture(scope="module")
def targets(mesh, views):
    return photograph(mesh, views)


def wrong(views: PinholeViews, degrees: float) -> PinholeViews:
    """Cameras that are off by so much, and by as much of the distance as parts of a radian."""
    rng = np.random.default_rng(5)
    size = np.radians(degrees) / np.sqrt(3)
    change = Corrections(size * rng.normal(size=(VIEWS, 3)), DISTANCE * size * rng.normal(size=(VIEWS, 3)))
    return change.views(views)


def aligned(mesh, targets, given: PinholeViews, *, textures: bool = True, moving=None):
    """The alignment after three steps for each of two blurs, and the verdict before."""
    alignment, verdict = Alignment(given, DISTANCE, moving), None
    texture_of, outline = Texture(mesh, targets, 6000, 0.02, 0), Outline(mesh, targets)
    for blur in (2.0, 1.0):
        compare = texture_of.level(blur, alignment.views)
        for _ in range(3):
            kinds = [compare(alignment.views)] if textures else []
            kinds += [outline.evidence(alignment.views)]
            verdict = verdict or alignment.verdicts(kinds)[0]
            alignment.step(kinds)
    return alignment, verdict


def error(mesh, views: PinholeViews, found: PinholeViews) -> float:
    """Median of the errors in pixels, but for what all cameras have in common."""
    turns = Rotation.from_matrix(found.bases @ np.linalg.inv(views.bases))
    left = Corrections(turns.as_rotvec(), found.origins - views.origins).as_given(views)
    return float(np.median(left.in_pixels(views, mesh[0][::50])))


@pytest.mark.parametrize("textures", [True, False])
def test_wrong_cameras_are_corrected(mesh, views, targets, textures):
    given = wrong(views, 0.5)
    assert error(mesh, views, given) > 0.9
    alignment, verdict = aligned(mesh, targets, given, textures=textures)
    assert verdict.accepted[0]
    assert error(mesh, views, alignment.views) < 0.35


def test_texture_that_slides_over_a_surface_is_none(mesh, views, targets):
    """As gloss does: outlines say that the cameras are right."""
    rng, slid = np.random.default_rng(4), []
    for target in targets:
        row, column = np.round(rng.uniform(-2.5, 2.5, 2)).astype(int)
        color = np.roll(target.rgba[..., :3], (row, column), axis=(0, 1))
        slid.append(dataclasses.replace(target, rgba=np.concatenate([color, target.rgba[..., 3:]], axis=-1)))
    texture = Texture(mesh, slid, 6000, 0.02, 0).level(2.0, views)(views)
    outline = Outline(mesh, slid).evidence(views)
    assert Alignment(views, DISTANCE).verdicts([texture])[0].accepted[0]
    every, each = Alignment(views, DISTANCE).verdicts([texture, outline])
    assert not every.accepted[0] and not each.accepted.any()


def test_one_camera_may_be_far_more_wrong_than_the_others(mesh, views, targets):
    """It goes most of the way, and they stay."""
    change = Corrections(np.zeros((VIEWS, 3)), np.zeros((VIEWS, 3)))
    change.rotations[4] = np.radians([1.0, -0.7, 0.5])
    alignment, _ = aligned(mesh, targets, change.views(views))
    kept = alignment.corrections.views(change.views(views))
    left = np.linalg.norm(kept.bases - views.bases, axis=(1, 2))
    wrong_by = np.linalg.norm(change.views(views).bases - views.bases, axis=(1, 2))[4]
    assert left[4] < 0.25 * wrong_by and np.median(left) < 0.02 * wrong_by


def test_a_single_wrong_camera_is_told_by_its_own_image(mesh, views, targets):
    """Then it goes most of the way. Of exact cameras none is told to be wrong."""
    change = Corrections(np.zeros((VIEWS, 3)), np.zeros((VIEWS, 3)))
    change.rotations[4] = np.radians([0.6, -0.3, 0.0])
    texture_of, outline = Texture(mesh, targets, 6000, 0.02, 0), Outline(mesh, targets)
    for given, wrong_one in ((views, False), (change.views(views), True)):
        every, each = Alignment(given, DISTANCE).verdicts(
            [texture_of.level(2.0, given)(given), outline.evidence(given)]
        )
        assert not every.accepted[0] and each.accepted[4] == wrong_one
        assert each.accepted.any() == wrong_one
    alignment, _ = aligned(mesh, targets, given, moving=each.accepted)
    left = change.after(alignment.corrections).in_pixels(views, mesh[0][::50])
    wrong_by = change.in_pixels(views, mesh[0][::50])[4]
    assert left[4] < 0.25 * wrong_by and np.delete(left, 4).max() < 0.05 * wrong_by


def test_cameras_stay_where_they_were_given_in_the_mean(mesh, views, targets):
    given = wrong(views, 0.5)
    alignment, _ = aligned(mesh, targets, given)
    again = alignment.corrections.as_given(given, alignment.precision)
    np.testing.assert_allclose(again.to_array(), alignment.corrections.to_array(), atol=1e-9)


def test_only_some_may_move(mesh, views, targets):
    """The others tell what places look like, and the exact ones tell it right."""
    given = wrong(views, 0.5)
    moving = np.arange(VIEWS) % 3 == 0
    bases, origins = (
        np.where(moving.reshape(-1, *[1] * (of.ndim - 1)), of, exact)
        for of, exact in ((given.bases, views.bases), (given.origins, views.origins))
    )
    given = dataclasses.replace(given, bases=bases, origins=origins)
    alignment, _ = aligned(mesh, targets, given, moving=moving)
    found = alignment.found
    assert not found.to_array()[~moving].any()
    turns = Rotation.from_matrix(alignment.views.bases @ np.linalg.inv(views.bases)).as_rotvec()
    left = Corrections(turns, alignment.views.origins - views.origins).in_pixels(views, mesh[0][::50])
    start = Rotation.from_matrix(given.bases @ np.linalg.inv(views.bases)).as_rotvec()
    before = Corrections(start, given.origins - views.origins).in_pixels(views, mesh[0][::50])
    assert (left[moving] < 0.3 * before[moving]).all()


def test_exact_cameras_stay(mesh, views, targets):
    alignment, _ = aligned(mesh, targets, views)
    assert np.median(alignment.corrections.in_pixels(views, mesh[0][::50])) < 0.05


def test_without_texture_the_outline_tells(mesh, views):
    plain, given = photograph(mesh, views, textured=False), wrong(views, 0.5)
    alignment, verdict = aligned(mesh, plain, given)
    assert verdict.accepted[0] and error(mesh, views, alignment.views) < 0.355 * error(mesh, views, given)


def test_what_is_unknown_tells_nothing(mesh, views, targets):
    """Half of each image is unknown, and wrong: it makes no difference."""
    spoilt = []
    for target in targets:
        rgba, known = target.rgba.copy(), np.ones((SIZE, SIZE), np.float32)
        rgba[:, : SIZE // 2], known[:, : SIZE // 2] = [0.9, 0.1, 0.9, 1.0], 0
        spoilt.append(Target(target.path, rgba, True, known=known))
    given = wrong(views, 0.5)
    alignment, _ = aligned(mesh, spoilt, given)
    assert error(mesh, views, alignment.views) < 0.4 * error(mesh, views, given)


def test_nothing_seen_changes_nothing(mesh, views):
    empty = [Target(Path(f"{name}.exr"), np.zeros((SIZE, SIZE, 4), np.float32), True) for name in views.ids]
    alignment, verdict = aligned(mesh, empty, views)
    assert not verdict.accepted[0]
    np.testing.assert_allclose(alignment.corrections.to_array(), 0, atol=1e-9)
