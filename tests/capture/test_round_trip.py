"""Every format with known ground truth: the imported scene sees known points at the same pixels."""

import json

import mitsuba as mi
import numpy as np
import pytest
from known_capture import BALL, CAPTURES, RADIUS, points
from PIL import Image
from scipy.ndimage import binary_erosion

from gshell_mi.capture import CaptureConfig, import_capture, read_capture
from gshell_mi.scene import load_fit_scene

#: Bar of the agreement, pixels; what is reached is about a hundred times better.
PIXELS = 0.05


@pytest.fixture(scope="module", params=list(CAPTURES))
def imported(request, tmp_path_factory):
    """The true cameras, the capture as read, and the scene as imported, at full size."""
    cameras, write = CAPTURES[request.param]
    folder = tmp_path_factory.mktemp("capture")
    source = folder / "source"
    source.mkdir()
    write(source, cameras)
    result = import_capture(source, folder / "ball.xml", config=CaptureConfig(max_size=0))
    return cameras, read_capture(source), load_fit_scene(result.path), result


def turned(scene, p):
    """World points of the capture in the scene."""
    record = json.loads((scene.path.with_suffix("") / "capture.json").read_text())
    matrix = np.array(record["capture_to_scene"])
    return p @ matrix[:3, :3].T + matrix[:3, 3]


def test_cameras_as_read_project_known_points_lens_included(imported):
    cameras, capture, _, _ = imported
    assert len(capture.frames) == len(cameras)
    for frame, truth in zip(capture.frames, cameras, strict=True):
        assert np.abs(frame.camera.project(points()) - truth.project(points())).max() < PIXELS / 100


def test_sensors_send_rays_through_known_points(imported):
    """Through Mitsuba itself: the ray of the pixel where a point must appear passes it closely."""
    cameras, _, scene, _ = imported
    p = turned(scene, points())
    worst = 0.0
    for sensor, truth in zip(scene.sensors, cameras, strict=True):
        width, height = sensor.film().size()
        assert (width, height) == (truth.width, truth.height)
        # Lens and oblong pixels are resampled away; the focal length along x stays.
        pixel = truth.ideal(points()) * truth.fx + [truth.cx, truth.cy]
        film = mi.Point2f((pixel / [width, height]).T.astype(np.float32))
        ray, _ = sensor.sample_ray(0.0, 0.5, film, mi.Point2f(0.5))
        origin, direction = np.array(ray.o).T.astype(float), np.array(ray.d).T.astype(float)
        to_point = p - origin
        to_point /= np.linalg.norm(to_point, axis=1, keepdims=True)
        worst = max(worst, np.linalg.norm(np.cross(direction, to_point), axis=1).max() * truth.fx)
    assert worst < PIXELS / 10


def test_targets_are_the_images_that_the_sensors_see(imported):
    """Against closed-form images of cameras without lens and with square pixels."""
    cameras, _, scene, _ = imported
    for target, truth in list(zip(scene.targets, cameras, strict=True))[::4]:
        straight = type(truth)(
            truth.origin,
            truth.forward,
            truth.up,
            truth.width,
            truth.height,
            truth.fx,
            truth.fx,
            truth.cx,
            truth.cy,
        )
        expected = straight.render()
        error = np.abs(target.rgba - expected)
        assert error.mean() < 0.006
        inside = binary_erosion(expected[..., 3] == 1, iterations=2)
        assert error[inside].max() < 0.02
        # Centroids of masks tell half a pixel's shift from none.
        assert np.abs(_centroid(target.rgba[..., 3]) - _centroid(expected[..., 3])).max() < PIXELS


def _centroid(alpha):
    v, u = np.mgrid[0.5 : alpha.shape[0], 0.5 : alpha.shape[1]]
    return np.array([(alpha * u).sum(), (alpha * v).sum()]) / alpha.sum()


def test_box_holds_the_object_closely(imported):
    _, _, scene, result = imported
    center = turned(scene, BALL[None])[0]
    low, high = result.box
    assert (low < center - RADIUS).all() and (high > center + RADIUS).all()
    assert np.ptp(result.box, axis=0).max() < 2 * 1.4 * RADIUS
    np.testing.assert_allclose(np.ptp(result.box, axis=0), np.ptp(result.box, axis=0)[0])
    matrix = np.array(scene.subject.to_world.matrix).reshape(4, 4)
    np.testing.assert_allclose(matrix[:3, 3], result.box.mean(axis=0), atol=1e-5)


def test_up_is_y(imported):
    cameras, _, scene, _ = imported
    mean = np.mean([camera.up for camera in cameras], axis=0)
    up = turned(scene, mean[None])[0] - turned(scene, np.zeros((1, 3)))[0]
    assert up[1] > 0.95 * np.linalg.norm(up)


def test_shrunk_scene_sees_the_same(tmp_path):
    cameras, write = CAPTURES["instant-ngp"]
    (tmp_path / "source").mkdir()
    write(tmp_path / "source", cameras)
    result = import_capture(tmp_path / "source", tmp_path / "small.xml", config=CaptureConfig(max_size=25))
    scene = load_fit_scene(result.path)
    scale = 25 / 60
    for sensor, target, truth in zip(scene.sensors, scene.targets, cameras, strict=True):
        assert tuple(sensor.film().size()) == (25, 18)
        fx, cx, cy = scale * truth.fx, scale * truth.cx, scale * truth.cy
        straight = type(truth)(truth.origin, truth.forward, truth.up, 25, 18, fx, fx, cx, cy)
        expected = straight.render(samples=8)
        assert np.abs(target.rgba - expected).mean() < 0.01
        assert np.abs(_centroid(target.rgba[..., 3]) - _centroid(expected[..., 3])).max() < PIXELS


def test_colmap_models_of_pycolmap(tmp_path):
    """COLMAP's own writer, and COLMAP's own projection."""
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 5, 50
    options.camera_model_id = pycolmap.CameraModelId.OPENCV
    options.camera_params = [400.0, 410.0, 320.0, 250.0, -0.05, 0.01, 0.001, -0.002]
    options.camera_width, options.camera_height = 640, 500
    model = pycolmap.synthesize_dataset(options)
    for kind, write in (("bin", model.write_binary), ("txt", model.write_text)):
        folder = tmp_path / kind
        (folder / "sparse").mkdir(parents=True)
        write(str(folder / "sparse"))
        for image in model.images.values():
            path = folder / "images" / image.name
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (640, 500)).save(path)
        by_name = {image.name: image for image in model.images.values()}
        xyz = np.array([point.xyz for point in model.points3D.values()])
        capture = read_capture(folder)
        assert len(capture.frames) == 5
        for frame in capture.frames:
            theirs = by_name[str(frame.image.relative_to(folder / "images"))]
            seen = [(theirs.project_point(p), p) for p in xyz]
            seen = [(pixel, p) for pixel, p in seen if pixel is not None]
            assert len(seen) > 5
            ours = frame.camera.project(np.array([p for _, p in seen]))
            np.testing.assert_allclose(ours, np.array([pixel for pixel, _ in seen]), atol=1e-4)
