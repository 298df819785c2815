"""Images of 8 and 16 bits as linear values, and files that would have Pillow start other programs."""

import struct
import zlib

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image, UnidentifiedImageError

from gshell_mi.float_images import image_size, read_float_image
from gshell_mi.integer_images import open_image, read_integer_image

VALUES = np.random.default_rng(0).integers(0, 256, (4, 6, 4), np.uint8)


@pytest.mark.parametrize("mode, channels", [("L", "Y"), ("LA", "YA"), ("RGB", "RGB"), ("RGBA", "RGBA")])
def test_eight_bits_become_linear(mode, channels, tmp_path):
    values = np.squeeze(VALUES[..., : len(channels)], axis=-1 if len(channels) == 1 else ())
    Image.fromarray(values, mode).save(tmp_path / "a.png")
    found, names = read_float_image(tmp_path / "a.png")
    unit = values.reshape(4, 6, -1) / 255
    linear = np.where(unit <= 0.04045, unit / 12.92, ((unit + 0.055) / 1.055) ** 2.4)
    if channels.endswith("A"):
        linear[..., -1] = unit[..., -1]
    np.testing.assert_allclose(found, linear, atol=1e-6)
    assert (names, image_size(tmp_path / "a.png")) == (channels, (6, 4))


def test_sixteen_bits_keep_their_steps(tmp_path):
    values = np.array([[[40000, 40001, 40002], [0, 1, 65535]]], np.uint16)
    mi.Bitmap(values).write(str(tmp_path / "a.png"))
    found, _ = read_float_image(tmp_path / "a.png")
    assert found[0, 0, 0] < found[0, 0, 1] < found[0, 0, 2] and found[0, 1, 2] == 1


def test_files_that_are_cut_off(tmp_path):
    for kind in ("png", "jpg", "bmp", "tga", "ppm"):
        path = tmp_path / f"a.{kind}"
        Image.fromarray(np.tile(VALUES[..., :3], (8, 8, 1))).save(path)
        path.write_bytes(path.read_bytes()[:-200])
        with pytest.raises((OSError, SyntaxError, ValueError)):
            read_float_image(path)


def test_documents_that_start_programs_are_no_images(tmp_path):
    """Pillow hands PostScript to Ghostscript."""
    Image.fromarray(VALUES[..., :3]).save(tmp_path / "a.eps")
    (tmp_path / "a.eps").rename(tmp_path / "a.png")
    assert Image.open(tmp_path / "a.png").format == "EPS"
    with pytest.raises(UnidentifiedImageError):
        open_image(tmp_path / "a.png")


@pytest.mark.parametrize("mode, clear", [("L", 40), ("RGB", (40, 50, 60))])
def test_a_transparent_colour_is_alpha(mode, clear, tmp_path):
    image = Image.new(mode, (2, 1), clear)
    image.putpixel((1, 0), 90 if mode != "RGB" else (90, 90, 90))
    image.save(tmp_path / "a.png", transparency=clear)
    assert read_integer_image(tmp_path / "a.png")[0, :, 3].tolist() == [0, 255]


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_absurd_sizes_are_refused_where_the_package_says(tmp_path):
    """Pillow's own limit is lower, and an error of no common kind."""
    for side, refused in ((15_000, False), (20_000, True), (60_000, True)):
        Image.new("L", (1, 1)).save(tmp_path / "a.png")
        data = bytearray((tmp_path / "a.png").read_bytes())
        data[16:24] = struct.pack(">II", side, side)
        data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
        (tmp_path / "a.png").write_bytes(data)
        if refused:
            with pytest.raises(ValueError, match="pixels"):
                open_image(tmp_path / "a.png")
        else:
            assert image_size(tmp_path / "a.png") == (side, side)
