"""Radiance HDR and PFM files as other programs write them, damaged ones, and hostile ones."""

import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.environment_maps import read_environment_map
from gshell_mi.errors import UserError
from gshell_mi.float_images import check_for_mitsuba, image_size, read_float_image

HEADER = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"
#: Two rows of eight pixels, each channel a run, and the start of a row.
ROW = b"\2\2\0\10" + b"\x88\x80\x88\x40\x88\x20\x88\x81"


def radiance(path, pixels):
    mi.Bitmap(np.asarray(pixels, np.float32)).write(str(path))
    return path


@pytest.mark.parametrize("size", [(8, 16), (5, 300), (3, 4), (1, 1)])
def test_what_mitsuba_writes_comes_back(size, tmp_path):
    """Noise is written as it is, an even half in runs, and narrow pictures unpacked."""
    pixels = np.random.default_rng(0).random((*size, 3)).astype(np.float32) * 100
    pixels[:, : size[1] // 2] = 0.25
    path = radiance(tmp_path / "a.hdr", pixels)
    found, channels = read_float_image(path)
    np.testing.assert_array_equal(found, np.array(mi.Bitmap(str(path))))
    assert (channels, image_size(path), found.dtype) == ("RGB", size[::-1], np.float32)
    # A step of 1/128 of the largest channel, as mantissas of eight bits have.
    assert (np.abs(found - pixels) <= pixels.max(axis=-1, keepdims=True) / 128 + 1e-6).all()


def test_flat_pixels_of_a_wide_picture(tmp_path):
    rgbe = np.random.default_rng(0).integers(128, 256, (2, 8, 4), np.uint8)
    rgbe[0, 3, 3] = 0  # black, whatever its colour
    (tmp_path / "a.hdr").write_bytes(HEADER.replace(b"\n", b"\r\n") + b"-Y 2 +X 8\n" + rgbe.tobytes())
    found, _ = read_float_image(tmp_path / "a.hdr")
    np.testing.assert_array_equal(found, np.array(mi.Bitmap(str(tmp_path / "a.hdr"))))
    assert (found[0, 3] == 0).all()


@pytest.mark.parametrize(
    "content, words",
    [
        # Mitsuba begins anew at a row that is not packed, and writes past the end.
        (HEADER + b"-Y 2 +X 8\n" + ROW + b"\x90\x10" * 40, "a scanline is damaged"),
        (HEADER + b"-Y 2 +X 8\n" + ROW + b"\2\2\0\10" + b"\x84\x80" * 7, "a scanline is damaged or cut off"),
        (HEADER + b"-Y 1 +X 8\n\2\2\0\10\x89\x80" + bytes(20), "a scanline is damaged or cut off"),
        (HEADER + b"-Y 1 +X 8\n\2\2\0\10\0\x80" + bytes(20), "a scanline is damaged or cut off"),
        (HEADER + b"-Y 2 +X 9\n" + ROW + ROW + bytes(20), "a scanline is damaged"),
        (HEADER + b"-Y 2 +X 2\n" + bytes(15), "for which it is too short"),
        (HEADER + b"-Y 4000 +X 4000\n" + ROW, "for which it is too short"),
        (HEADER + b"-Y 4000000 +X 4000000\n" + ROW, "promises 4000000 x 4000000 pixels"),
        (HEADER + b"-Y 0 +X 8\n" + ROW, "promises 8 x 0 pixels"),
        (HEADER + b"-Y,2,+X,8\n" + ROW + ROW, "do not begin at the top left"),
        (HEADER + b" -Y 99999 +X 8\n-Y 2 +X 8\n" + ROW + ROW, "do not begin at the top left"),
        (HEADER + b"note\r-Y 99999 +X 8\n-Y 2 +X 8\n" + ROW + ROW, "its header is damaged"),
        (HEADER + b"+Y 2 +X 8\n" + ROW + ROW, "do not begin at the top left"),
        (HEADER + b"-Y 1 +X 2\n" + bytes((128, 128, 128, 128, 1, 1, 1, 1)), "packed in the oldest way"),
        (HEADER.replace(b"rgbe", b"xyze") + b"-Y 1 +X 8\n" + ROW, "stored as 32-bit_rle_xyze"),
        (b"#?RADIANCE\n\n-Y 1 +X 8\n" + ROW, "stored as nothing known"),
        (HEADER, "its header says no size"),
        (b"#?" + b"x" * 100_000, "its header is damaged"),
        (b"PF\n2 2\n-1.0\n" + bytes(47), "for which it is too short"),
        (b"PF\n1000000 1000000\n-1.0\n" + bytes(48), "promises 1000000 x 1000000 pixels"),
        (b"PF\n-2 2\n-1.0\n" + bytes(48), "its header is damaged"),
        (b"PF\n2 2\nnan\n" + bytes(48), "its header is damaged"),
        (b"Pf\n2 2\n0\n" + bytes(48), "its header is damaged"),
    ],
)
def test_damage_is_named(content, words, tmp_path):
    """None of these may reach Mitsuba, which some of them crash."""
    for name in ("a.hdr", "a.pfm", "a.png"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=words):
            check_for_mitsuba(tmp_path / name)
        with pytest.raises(UserError, match=rf"Map .*cannot be read as an image \(.*{words}"):
            read_environment_map(tmp_path / name, "Map")


@pytest.mark.parametrize("kind, channels", [("PF", 3), ("Pf", 1)])
@pytest.mark.parametrize("scale, order", [("-1.0", "<f4"), ("2", ">f4"), ("-5e-1", "<f4")])
def test_float_maps(kind, channels, scale, order, tmp_path):
    """The lowest row comes first; the scale's sign is the order of bytes."""
    pixels = np.random.default_rng(0).random((3, 5, channels)).astype(np.float32)
    path = tmp_path / "a.pfm"
    path.write_bytes(f"{kind}\n5 3\n{scale}\n".encode() + pixels[::-1].astype(order).tobytes())
    found, names = read_float_image(path)
    np.testing.assert_allclose(found, pixels * abs(float(scale)), rtol=1e-6)
    np.testing.assert_array_equal(found.ravel(), np.array(mi.Bitmap(str(path))).ravel())
    assert (names, image_size(path)) == ("RGB" if channels == 3 else "Y", (5, 3))
