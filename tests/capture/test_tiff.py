"""TIFF files of every layout."""

import numpy as np
import pytest
import tifffile
from PIL import Image

from gshell_mi.capture.decoding import image_size, read_pixels
from gshell_mi.errors import UserError

PIXELS = np.random.default_rng(0).random((6, 8, 4)).astype(np.float32)


def test_floating_point(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", PIXELS, photometric="rgb", extrasamples=["unassalpha"])
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.tif"), PIXELS)
    assert image_size(tmp_path / "a.tif") == (8, 6)


def test_colour_is_freed_of_alpha(tmp_path):
    multiplied = PIXELS * np.append(PIXELS[..., 3:].repeat(3, axis=2), np.ones_like(PIXELS[..., :1]), axis=2)
    tifffile.imwrite(tmp_path / "a.tif", multiplied, photometric="rgb", extrasamples=["assocalpha"])
    np.testing.assert_allclose(read_pixels(tmp_path / "a.tif"), PIXELS, rtol=1e-5)
    stored = np.array([[[50, 100, 20, 100], [0, 0, 0, 0], [255, 1, 0, 255]]], np.uint8)
    tifffile.imwrite(tmp_path / "b.tif", stored, photometric="rgb", extrasamples=["assocalpha"])
    expected = np.array([[[0.5, 1, 0.2, 100 / 255], [0, 0, 0, 0], [1, 1 / 255, 0, 1]]])
    found = read_pixels(tmp_path / "b.tif")
    assert found.dtype == np.uint16
    np.testing.assert_allclose(found / 65535, expected, atol=1e-5)


@pytest.mark.parametrize(
    "options, expected",
    [({"photometric": "rgb", "planarconfig": "separate"}, (6, 8, 3)), ({"photometric": "rgb"}, (6, 8, 3))],
)
def test_planes_and_pixels(options, expected, tmp_path):
    stored = (255 * PIXELS[..., :3]).astype(np.uint8)
    separate = np.moveaxis(stored, -1, 0) if "planarconfig" in options else stored
    tifffile.imwrite(tmp_path / "a.tif", separate, **options)
    found = read_pixels(tmp_path / "a.tif")
    assert found.shape == expected
    np.testing.assert_array_equal(found, stored)


def test_colours_that_are_not_rgb(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((6, 8, 4), np.uint8), photometric="separated")
    with pytest.raises(UserError, match="colours are stored as SEPARATED"):
        read_pixels(tmp_path / "a.tif")


def test_colours_of_no_known_kind_are_told(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, (255 * PIXELS[..., :3]).astype(np.uint8), photometric="rgb")
    with tifffile.TiffFile(path) as file:
        place = file.pages.first.tags["PhotometricInterpretation"].valueoffset
    data = bytearray(path.read_bytes())
    data[place : place + 2] = (12345).to_bytes(2, "little")
    path.write_bytes(data)
    with pytest.raises(UserError, match="12345"):
        read_pixels(path)


@pytest.mark.parametrize("compression", ["tiff_lzw", "jpeg", "packbits", "tiff_adobe_deflate"])
def test_compressed_photographs(compression, tmp_path):
    stored = np.tile(np.array([200, 100, 50], np.uint8), (16, 16, 1))
    Image.fromarray(stored).save(tmp_path / "a.tif", compression=compression)
    found = read_pixels(tmp_path / "a.tif")
    assert found.shape == (16, 16, 3) and np.abs(found.astype(int) - stored).max() < 4


@pytest.mark.parametrize("compression", [None, "group4", "tiff_lzw"])
def test_masks_of_one_bit(compression, tmp_path):
    stored = PIXELS[..., 0] > 0.5
    Image.fromarray(stored).save(tmp_path / "a.tif", compression=compression)
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.tif")[..., 0], 255 * stored)


def test_sixteen_bits_that_nothing_here_unpacks_are_told(tmp_path):
    """Pillow would hand out 8 of them."""
    Image.fromarray((65535 * PIXELS[..., 0]).astype(np.uint16)).save(
        tmp_path / "a.tif", compression="tiff_lzw"
    )
    with pytest.raises(UserError, match="imagecodecs"):
        read_pixels(tmp_path / "a.tif")
