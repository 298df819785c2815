"""JPEG files that are decoded at a fraction of their size."""

from pathlib import Path

import numpy as np
import pytest
from known_capture import known_cameras
from PIL import Image

from gshell_mi.capture import Camera
from gshell_mi.capture.frames import Frame, camera_for_image, same_aspect
from gshell_mi.capture.parallel import in_order
from gshell_mi.capture.prepare import Preparation
from gshell_mi.capture.reduced import match_size, read_reduced, reduced_camera


def gradient(width, height):
    """A smooth picture, linear in the column and in the row."""
    v, u = np.mgrid[0.5:height, 0.5:width]
    return np.stack([255 * u / width, 255 * v / height, 0 * u + 100], axis=-1)


@pytest.mark.parametrize("size", [(403, 301), (400, 304)])
def test_reduced_pixels_are_where_their_camera_says(size, tmp_path):
    Image.fromarray(gradient(*size).astype(np.uint8)).save(tmp_path / "a.jpg", quality=98)
    pixels, reduction = read_reduced(tmp_path / "a.jpg", 100)
    assert reduction == 4
    camera = reduced_camera(Camera(*size, 500.0, 500.0, size[0] / 2, size[1] / 2, np.eye(4)), reduction)
    assert pixels.shape[:2] == (camera.height, camera.width)
    # The small pixel that the camera has at a direction shows what the large image has there.
    column = (np.arange(20, 80) + 0.5 - camera.cx) / camera.fx * 500 + size[0] / 2
    np.testing.assert_allclose(pixels[30, 20:80, 0], 255 * column / size[0], atol=2.5)


@pytest.mark.parametrize("name", ["a.png", "b.jpg"])
def test_other_files_and_small_ones_are_read_in_full(name, tmp_path):
    Image.fromarray(gradient(160, 120).astype(np.uint8)).save(tmp_path / name)
    pixels, reduction = read_reduced(tmp_path / name, 100)
    assert reduction == 1 and pixels.shape == (120, 160, 3)


def test_targets_of_reduced_photographs_are_those_of_whole_ones(tmp_path):
    c = known_cameras(1, width=800, height=600, fx=900.0, fy=900.0, cx=400.0, cy=300.0)[0]
    rgba = c.render(samples=1)
    picture = (255 * (rgba[..., :3] + 0.3 * (1 - rgba[..., 3:]))).astype(np.uint8)
    Image.fromarray((255 * rgba[..., 3]).astype(np.uint8)).save(tmp_path / "mask.png")
    Image.fromarray(picture).save(tmp_path / "a.jpg", quality=97, subsampling=0)
    Image.fromarray(picture).save(tmp_path / "a.png")
    camera = Camera(800, 600, 900.0, 900.0, 400.0, 300.0, np.eye(4))
    whole, reduced = (
        Preparation(max_size=100).target(Frame(tmp_path / name, camera, tmp_path / "mask.png"))
        for name in ("a.png", "a.jpg")
    )
    assert read_reduced(tmp_path / "a.jpg", 200)[1] == 4
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(whole.camera, name) == pytest.approx(getattr(reduced.camera, name))
    assert np.abs(whole.rgba - reduced.rgba).mean() < 0.003
    assert np.abs(whole.rgba[..., 3] - reduced.rgba[..., 3]).max() < 0.01


def test_masks_of_another_size_but_the_same_aspect_fit():
    mask = np.zeros((30, 40), np.float32)
    mask[:, 20:] = 1
    larger = match_size(mask, (400, 300), (300, 400), 1)
    assert larger.shape == (300, 400) and (larger[:, 210:] == 1).all() and (larger[:, :190] == 0).all()
    smaller = match_size(mask, (40, 30), (8, 10), 4)
    np.testing.assert_array_equal(smaller, np.tile(np.repeat([0.0, 1.0], 5), (8, 1)))
    assert match_size(mask, (300, 400), (400, 300), 1) is None


@pytest.mark.parametrize(
    "large, small",
    [
        ((6000, 4000), (1600, 1067)),
        ((5472, 3648), (1600, 1067)),
        ((6960, 4640), (1600, 1067)),
        ((4000, 6000), (1067, 1600)),
        ((4033, 3025), (1008, 756)),
        ((4031, 3023), (1008, 756)),
    ],
)
def test_copies_have_the_aspect_that_rounding_leaves(large, small):
    """Rounded, cut off or rounded up: a camera or a mask for either fits the other, but none a pixel away."""
    for first, second in ((large, small), (small, large)):
        assert same_aspect(first, second)
        camera = Camera(*first, 2000.0, 2000.0, first[0] / 2, first[1] / 2, np.eye(4))
        fitted = camera_for_image(camera, second, Path("a.jpg"))
        assert (fitted.width, fitted.height) == second and fitted.cx == pytest.approx(second[0] / 2)
    assert not same_aspect(large, (small[0], small[1] - 2))
    assert not same_aspect(large, large[::-1])
    mask = np.ones(large[::-1], np.float32)
    assert (match_size(mask, small, small[::-1], 1) == 1).all()


def test_work_in_order_tells_errors_and_stops():
    seen = []

    def work(item):
        seen.append(item)
        if item == 3:
            raise ValueError("three")
        return item

    results = in_order(work, range(1000), threads=2)
    with pytest.raises(ValueError, match="three"):
        list(results)
    assert len(seen) < 20
