"""Decoding, masks, exposure, down-scaling."""

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from known_capture import LENS, distort, known_cameras, write_colmap, write_nerf
from PIL import Image

from gshell_mi.capture import Camera, Distortion, read_capture
from gshell_mi.capture.decoding import ColorDecoding, exif_exposure, read_pixels
from gshell_mi.capture.frames import Capture, Frame
from gshell_mi.capture.masks import Background, assign_masks, coverage_of
from gshell_mi.capture.prepare import Preparation, exposure_gains
from gshell_mi.capture.resample import rectify, shrink
from gshell_mi.errors import UserError
from gshell_mi.images import srgb

RGBA = np.random.default_rng(2).integers(0, 256, (6, 8, 4), dtype=np.uint8)


def camera(width=8, height=6, **options):
    return Camera(width, height, 9.0, 9.0, width / 2, height / 2, np.eye(4), **options)


# --- decoding


def test_decoding_of_srgb_is_its_inverse():
    linear = ColorDecoding().linear(np.arange(256, dtype=np.uint8).repeat(3).reshape(1, -1, 3))
    assert linear.dtype == np.float32
    np.testing.assert_array_equal((srgb(linear) * 255 + 0.5).astype(int)[0, :, 0], np.arange(256))


@pytest.mark.parametrize(
    "transfer, value, linear",
    [
        ("linear", 0.5, 0.5),
        ("Gamma 2.2", 0.5, 0.5**2.2),
        ("ITU-R BT.709", 0.081, 0.018),
        (None, 0.5, 0.21404),
    ],
)
def test_transfer_functions(transfer, value, linear):
    deep = np.full((1, 1, 3), round(value * 65535), np.uint16)
    assert ColorDecoding(transfer=transfer).linear(deep)[0, 0, 1] == pytest.approx(linear, abs=2e-4)


def test_wide_primaries_come_out_in_rec709():
    """Display P3's red lies outside of Rec.709; its white is the same."""
    decoding = ColorDecoding("Display P3")
    white, red = decoding.linear(np.array([[[255] * 3, [255, 0, 0]]], np.uint8))[0]
    np.testing.assert_allclose(white, 1, atol=1e-3)
    np.testing.assert_allclose(red, [1.2249, 0, 0], atol=1e-3)  # green and blue would be negative
    floats = ColorDecoding("ACEScg").linear(np.full((1, 1, 3), 0.18, np.float32))
    np.testing.assert_allclose(floats, 0.18, atol=1e-3)  # grey stays grey, and linear stays linear


@pytest.mark.parametrize(
    "mode, expected", [("L", 3), ("LA", 4), ("RGB", 3), ("RGBA", 4), ("1", 3), ("P", 4), ("CMYK", 3)]
)
def test_every_layout_becomes_rgb_or_rgba(mode, expected, tmp_path):
    path = tmp_path / ("image.jpg" if mode == "CMYK" else "image.png")
    Image.fromarray(RGBA).convert(mode).save(path)
    assert read_pixels(path).shape == (6, 8, expected)


def test_16_bits_are_read_in_full(tmp_path):
    deep = np.random.default_rng(0).integers(0, 65536, (6, 8, 4), dtype=np.uint16)
    mi.Bitmap(deep).write(str(tmp_path / "deep.png"))
    np.testing.assert_array_equal(read_pixels(tmp_path / "deep.png"), deep)


def test_colour_of_a_multi_channel_exr_is_found(tmp_path):
    pixels = np.random.default_rng(0).random((6, 8, 5), dtype=np.float32)
    bitmap = mi.Bitmap(pixels, mi.Bitmap.PixelFormat.MultiChannel, ["R", "G", "B", "A", "depth.Z"])
    bitmap.write(str(tmp_path / "layers.exr"))
    np.testing.assert_array_equal(read_pixels(tmp_path / "layers.exr"), pixels[..., :4])


# --- alpha, masks, background


def prepared(path, **options):
    return Preparation(**options).target(Frame(path, camera())).rgba


def test_png_has_straight_and_exr_premultiplied_alpha(tmp_path):
    Image.fromarray(RGBA).save(tmp_path / "a.png")
    linear = ColorDecoding().linear(RGBA[..., :3])
    alpha = RGBA[..., 3:] / np.float32(255)
    np.testing.assert_allclose(
        prepared(tmp_path / "a.png"), np.concatenate([linear * alpha, alpha], -1), atol=1e-6
    )
    floats = np.concatenate([linear * alpha, alpha], -1).astype(np.float32)
    mi.Bitmap(floats).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(prepared(tmp_path / "a.exr"), floats)


@pytest.mark.parametrize("kind", ["8 bit", "16 bit", "RGB", "in alpha", "float"])
def test_masks_of_every_kind(kind, tmp_path):
    mask = np.tile(np.array([0, 51, 204, 255], np.uint8), (6, 2))
    path = tmp_path / ("mask.exr" if kind == "float" else "mask.png")
    if kind == "8 bit":
        Image.fromarray(mask).save(path)
    elif kind == "16 bit":
        mi.Bitmap(mask.astype(np.uint16)[..., None] * 257).write(str(path))
    elif kind == "RGB":
        Image.fromarray(mask).convert("RGB").save(path)
    elif kind == "in alpha":
        Image.fromarray(np.dstack([np.zeros((6, 8, 3), np.uint8), mask])).save(path)
    else:
        mi.Bitmap((mask / np.float32(255))[..., None]).write(str(path))
    frame = Frame(Path("unused"), camera(), mask=path)
    np.testing.assert_allclose(coverage_of(frame, RGBA), mask / 255, atol=1e-5)
    np.testing.assert_allclose(coverage_of(frame, RGBA, inverted=True), 1 - mask / 255, atol=1e-5)


def test_a_mask_overrules_alpha(tmp_path):
    Image.fromarray(RGBA).save(tmp_path / "a.png")
    Image.new("L", (8, 6), 255).save(tmp_path / "m.png")
    result = Preparation().target(Frame(tmp_path / "a.png", camera(), mask=tmp_path / "m.png")).rgba
    np.testing.assert_array_equal(result[..., 3], 1)
    np.testing.assert_array_equal(result[..., :3], ColorDecoding().linear(RGBA[..., :3]))


@pytest.mark.parametrize("names", [["a.png", "b.c.png"], ["a.jpg.png", "b.c.jpg.png"], ["A1.png", "A2.png"]])
def test_masks_are_found_by_name_else_by_order(names, tmp_path):
    for folder, files in (("images", ["a.jpg", "b.c.jpg"]), ("masks", names)):
        (tmp_path / folder).mkdir()
        for file in files:
            Image.new("L", (8, 6)).save(tmp_path / folder / file)
    frames = tuple(Frame(tmp_path / "images" / file, camera()) for file in ("a.jpg", "b.c.jpg"))
    found = assign_masks(Capture("test", tmp_path, frames), None).frames
    assert [frame.mask.name for frame in found] == names


@pytest.mark.parametrize("named", [True, False])
def test_a_photograph_is_not_its_own_mask(named, tmp_path):
    """Masks beside the photographs."""
    for file in ("a.jpg", "b.c.jpg", *(("a.jpg.png", "b.c.png") if named else ())):
        Image.new("L", (8, 6)).save(tmp_path / file)
    frames = tuple(Frame(tmp_path / file, camera()) for file in ("a.jpg", "b.c.jpg"))
    if not named:
        with pytest.raises(UserError, match="0 masks, 2 images"):
            assign_masks(Capture("test", tmp_path, frames), tmp_path)
        return
    found = assign_masks(Capture("test", tmp_path, frames), tmp_path).frames
    assert [frame.mask.name for frame in found] == ["a.jpg.png", "b.c.png"]


def test_a_mask_cuts_anew_what_its_file_has_premultiplied(tmp_path):
    """Or the outline would be darkened by the square of its coverage."""
    alpha = np.tile(np.float32([0, 0.25, 0.5, 1]), (6, 2))[..., None]
    color = np.full((6, 8, 3), np.float32(0.8))
    color[:, ::4] = 0
    mi.Bitmap(np.concatenate([color * alpha, alpha], -1)).write(str(tmp_path / "a.exr"))
    mi.Bitmap(alpha).write(str(tmp_path / "m.exr"))
    result = Preparation().target(Frame(tmp_path / "a.exr", camera(), mask=tmp_path / "m.exr")).rgba
    np.testing.assert_allclose(result, np.concatenate([color * alpha, alpha], -1), atol=1e-6)


def test_a_known_background_is_taken_away(tmp_path):
    """Also from the pixels at the outline, which mix both colours."""
    green = np.array([0, 200, 0])
    image = np.tile(green, (6, 8, 1)).astype(np.uint8)
    image[:, :4] = [180, 30, 90]
    image[:, 4] = green + 13  # half of the tolerance away
    Image.fromarray(image).save(tmp_path / "a.png")
    rgba = prepared(tmp_path / "a.png", background=Background.parse("#00c800"))
    np.testing.assert_array_equal(rgba[:, :4, 3], 1)
    np.testing.assert_allclose(rgba[:, 5:], 0, atol=1e-6)
    np.testing.assert_allclose(rgba[:, 4, 3], 0.51, atol=0.01)
    linear = ColorDecoding().linear(image)
    np.testing.assert_array_equal(rgba[:, :4, :3], linear[:, :4])
    expected = linear[:, 4] - (1 - rgba[:, 4, 3:]) * linear[:, 7]
    np.testing.assert_allclose(rgba[:, 4, :3], np.maximum(expected, 0), atol=1e-6)


def test_clipped_highlights_are_counted(tmp_path):
    image = np.full((6, 8, 4), 255, np.uint8)
    image[:3, :, :3] = 254
    Image.fromarray(image).save(tmp_path / "a.png")
    Image.new("L", (8, 6), 255).save(tmp_path / "m.png")
    frame = Frame(tmp_path / "a.png", camera(), mask=tmp_path / "m.png")
    assert Preparation().target(frame).clipped == 0.5


# --- exposure


def photograph(path, seconds, iso, aperture):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x829A: seconds, 0x829D: aperture, 0x8827: iso})
    Image.new("RGB", (8, 6), (128,) * 3).save(path, exif=exif)
    return Frame(path, camera())


def test_exif_exposures_are_evened_out(tmp_path):
    settings = {
        "a": (1 / 100, 100, 2.0),
        "b": (1 / 25, 100, 2.0),
        "c": (1 / 100, 400, 2.0),
        "d": (1 / 25, 400, 4.0),
    }
    frames = tuple(photograph(tmp_path / f"{name}.jpg", *values) for name, values in settings.items())
    assert exif_exposure(frames[1].image) == pytest.approx(np.log2(1 / 25 / 4))
    gains = exposure_gains(Capture("test", tmp_path, frames), None)
    a, b, c, d = (gains[frame.image] for frame in frames)
    assert (a / b, a / c, a / d) == pytest.approx((4, 4, 4))
    assert np.prod([a, b, c, d]) == pytest.approx(1)
    Image.new("RGB", (8, 6)).save(tmp_path / "e.jpg")
    incomplete = Capture("test", tmp_path, (*frames, Frame(tmp_path / "e.jpg", camera())))
    assert exposure_gains(incomplete, None) == {}


def test_given_exposures_scale_the_target(tmp_path):
    for name in ("a.png", "b.png"):
        Image.fromarray(RGBA).save(tmp_path / name)
    (tmp_path / "stops.json").write_text(json.dumps({"a.png": 1.0, "b.png": -1.0}))
    frames = tuple(Frame(tmp_path / name, camera()) for name in ("a.png", "b.png"))
    gains = exposure_gains(Capture("test", tmp_path, frames), tmp_path / "stops.json")
    a, b = (Preparation(gains=gains).target(frame).rgba for frame in frames)
    np.testing.assert_allclose(b[..., :3], 4 * a[..., :3], rtol=1e-5)
    np.testing.assert_array_equal(a[..., 3], b[..., 3])


def test_times_are_no_stops(tmp_path):
    for name in ("a.png", "b.png"):
        Image.fromarray(RGBA).save(tmp_path / name)
    (tmp_path / "stops.json").write_text(json.dumps({"a.png": 4000, "b.png": 60}))
    frames = tuple(Frame(tmp_path / name, camera()) for name in ("a.png", "b.png"))
    with pytest.raises(UserError, match=r"stops\.json' has exposures 3.94e\+03 stops apart, .* not shutter"):
        exposure_gains(Capture("test", tmp_path, frames), tmp_path / "stops.json")


# --- resampling


@pytest.mark.parametrize("size", [(30, 20, 10), (31, 17, 10), (40, 40, 39), (7, 100, 64)])
def test_shrinking_averages_areas(size):
    """An image of x + 2 y: each new pixel holds the value at its own centre. A constant stays one."""
    width, height, longest = size
    v, u = np.mgrid[0.5:height, 0.5:width]
    image = np.stack([u + 2 * v, np.ones_like(u)], axis=-1).astype(np.float32)
    small, shrunk = shrink(image, camera(width, height), longest)
    scale = longest / max(width, height)
    assert max(shrunk.width, shrunk.height) == longest and small.shape[:2] == (shrunk.height, shrunk.width)
    assert shrunk.fx == pytest.approx(9 * scale) and shrunk.cx == pytest.approx(width / 2 * scale)
    np.testing.assert_allclose(small[..., 1], 1, rtol=1e-5)
    # The mean over a pixel of a piecewise constant image of x is exact to a fraction of an old pixel.
    v, u = np.mgrid[0.5 : shrunk.height, 0.5 : shrunk.width] / scale
    np.testing.assert_allclose(small[..., 0], u + 2 * v, atol=0.13 / scale if longest < 39 else 0.8)


def test_whole_factors_are_exact():
    image = np.random.default_rng(0).random((12, 20, 3), dtype=np.float32)
    small, _ = shrink(image, camera(20, 12), 5)
    np.testing.assert_allclose(small, image.reshape(3, 4, 5, 4, 3).mean(axis=(1, 3)), rtol=1e-5)
    same, unchanged = shrink(image, camera(20, 12), 64)
    assert same is image and unchanged.width == 20


def test_a_pinhole_image_is_left_alone():
    image = np.random.default_rng(0).random((6, 8, 4), dtype=np.float32)
    assert rectify(image, camera())[0] is image


def test_lens_formula_is_opencvs():
    q = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    lens = LENS | {"k3": 0.02, "k4": 0.01}
    np.testing.assert_allclose(Distortion(**lens).apply(q), distort(q, **lens))


def test_a_strong_barrel_lens_does_not_fold_the_corners_back_in():
    """Beyond the radius at which the polynomial turns, its image would show the middle again."""
    lens = Distortion(k1=-0.5)
    wide = Camera(40, 40, 12.0, 12.0, 20.0, 20.0, np.eye(4), lens)
    assert lens.folds_at() == pytest.approx(np.sqrt(1 / 1.5)) and np.hypot(20, 20) / 12 > lens.folds_at()
    v, u = np.mgrid[0.5:40, 0.5:40]
    radius = np.hypot(u - 20, v - 20)[..., None].repeat(4, axis=-1).astype(np.float32)
    straight, _ = rectify(radius / radius.max(), wide)
    assert straight[0, 0, 0] > straight[20, 20, 0]
    assert (np.diff(straight[20, 20:, 0]) >= -1e-6).all()


def test_shrinking_and_undistorting_commute(tmp_path):
    """The lens formula is in units of the focal length, so the small image needs no other one."""
    write_nerf(tmp_path, known_cameras(1, lens=LENS), "ngp")
    frame = read_capture(tmp_path).frames[0]
    image = ColorDecoding().linear(read_pixels(frame.image)[..., :3])
    first, _ = shrink(*rectify(image, frame.camera), 30)
    last, _ = rectify(*shrink(image, frame.camera, 30))
    assert np.abs(first - last).mean() < 0.004


# --- errors of the library


def test_errors_name_what_to_supply(tmp_path):
    write_colmap(tmp_path, known_cameras(2))
    for file in (tmp_path / "masks").iterdir():
        file.unlink()
    (tmp_path / "masks").rmdir()
    frame = read_capture(tmp_path).frames[0]
    with pytest.raises(UserError, match=r"'masks' beside the images or with --masks, or .* --background"):
        coverage_of(frame, read_pixels(frame.image))
