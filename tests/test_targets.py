"""What a target image may be, and what it is turned into."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from gshell_mi import UserError
from gshell_mi.targets import Target, load_target


@pytest.fixture
def pixels() -> np.ndarray:
    """(5, 7, 4): five rows of seven premultiplied pixels."""
    rng = np.random.default_rng(1)
    alpha = rng.random((5, 7, 1))
    return np.concatenate([3 * alpha * rng.random((5, 7, 3)), alpha], axis=-1).astype(np.float32)


@pytest.fixture
def write(tmp_path):
    def write(pixels, component=mi.Struct.Type.Float32):
        bitmap = mi.Bitmap(np.ascontiguousarray(pixels))
        bitmap.convert(component_format=component).write(str(tmp_path / "a.exr"))
        return tmp_path / "a.exr"

    return write


def test_rgba_is_read_as_it_is(write, pixels):
    path = write(pixels)
    target = load_target(path, 7, 5)
    assert target.path == path and target.has_alpha
    assert target.rgba.dtype == np.float32
    np.testing.assert_array_equal(target.rgba, pixels)


def test_half_floats(write, pixels):
    target = load_target(write(pixels, mi.Struct.Type.Float16), 7, 5)
    assert target.rgba.dtype == np.float32
    np.testing.assert_array_equal(target.rgba, pixels.astype(np.float16).astype(np.float32))


def test_without_alpha_coverage_is_one(write, pixels):
    target = load_target(write(pixels[..., :3]), 7, 5)
    assert not target.has_alpha
    np.testing.assert_array_equal(target.rgba[..., :3], pixels[..., :3])
    assert (target.rgba[..., 3] == 1).all()


def test_missing(tmp_path):
    with pytest.raises(UserError, match=r"none.exr' is missing; .* --targets"):
        load_target(tmp_path / "none.exr", 7, 5)
    with pytest.raises(UserError, match="is missing"):
        load_target(tmp_path, 7, 5)


def test_size(write, pixels):
    with pytest.raises(UserError, match=r"is 7 x 5 pixels, but its sensor's film is 5 x 7"):
        load_target(write(pixels), 5, 7)


@pytest.mark.parametrize("channel", [0, 3])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_not_finite(write, pixels, channel, value):
    pixels[4, 2, channel] = pixels[4, 6, channel] = value
    with pytest.raises(UserError, match=r"NaN or infinity \(first at column 2, row 4\)"):
        load_target(write(pixels), 7, 5)


@pytest.mark.parametrize("keep", [0, 10, 200])
def test_truncated(write, pixels, keep):
    path = write(pixels)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(UserError, match=r"a.exr' cannot be read as an image \(.+\); write it again"):
        load_target(path, 7, 5)


@pytest.mark.parametrize("channels", [1, 2, 5])
def test_other_channels(write, pixels, channels):
    with pytest.raises(UserError, match="a target needs R, G, B and A"):
        load_target(write(np.resize(pixels, (5, 7, channels))), 7, 5)


@pytest.mark.parametrize(("alpha", "kept"), [(1.04, 1), (-0.04, 0)])
def test_what_filters_and_rounding_overshoot_is_clipped(write, pixels, alpha, kept):
    pixels[1, 1, 3] = alpha
    target = load_target(write(pixels), 7, 5)
    assert target.rgba[1, 1, 3] == kept
    np.testing.assert_array_equal(target.rgba[..., :3], pixels[..., :3])


@pytest.mark.parametrize("alpha", [1.06, -0.06, 255])
def test_alpha_is_coverage(write, pixels, alpha):
    pixels[1, 1, 3] = alpha
    with pytest.raises(UserError, match=rf"alpha between .*{alpha}.*; alpha is coverage"):
        load_target(write(pixels), 7, 5)


@pytest.mark.parametrize(("share", "whole"), [(1.0, True), (0.3, False), (0.0, False)])
def test_a_target_is_known_if_every_pixel_wholly_is(pixels, share, whole):
    known = np.ones(pixels.shape[:2], np.float32)
    known[0] = share
    assert Target(Path("a.exr"), pixels, True, known=known).is_known == whole
