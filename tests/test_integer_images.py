"""Images of 8 and 16 bits as linear values, and files that would have Pillow start other programs."""

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image, UnidentifiedImageError

from gshell_mi.float_images import image_size, read_float_image
from gshell_mi.integer_images import open_image

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
