"""OpenEXR files as other programs write them: windows, layers, parts and damage."""

import numpy as np
import OpenEXR
import pytest

from gshell_mi.float_images import first_not_finite, image_size, read_float_image

PIXELS = np.random.default_rng(0).random((30, 40, 4)).astype(np.float32)
DISPLAY = ((0, 0), (39, 29))


def header(**values):
    return {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **values}


def channels(pixels, names):
    return {name: np.ascontiguousarray(pixels[..., index]) for index, name in enumerate(names)}


def write(path, pixels, names="RGBA", corner=(0, 0), display=DISPLAY):
    height, width = pixels.shape[:2]
    window = corner, (corner[0] + width - 1, corner[1] + height - 1)
    OpenEXR.File(header(displayWindow=display, dataWindow=window), channels(pixels, names)).write(str(path))
    return path


def test_overscan_is_cut_off(tmp_path):
    """The data window begins at (-6, -4) and ends as far beyond the display window."""
    wider = np.pad(PIXELS, ((4, 4), (6, 6), (0, 0)), mode="reflect")
    path = write(tmp_path / "a.exr", wider, corner=(-6, -4))
    found, names = read_float_image(path)
    np.testing.assert_array_equal(found, PIXELS)
    assert (names, image_size(path)) == ("RGBA", (40, 30))


def test_a_crop_is_put_in_its_place(tmp_path):
    path = write(tmp_path / "a.exr", PIXELS[3:15, 5:25], corner=(5, 3))
    expected = np.zeros_like(PIXELS)
    expected[3:15, 5:25] = PIXELS[3:15, 5:25]
    np.testing.assert_array_equal(read_float_image(path)[0], expected)
    assert image_size(path) == (40, 30)


def test_windows_count_from_the_display_window(tmp_path):
    """Both windows begin at (100, 50)."""
    path = write(tmp_path / "a.exr", PIXELS, corner=(100, 50), display=((100, 50), (139, 79)))
    np.testing.assert_array_equal(read_float_image(path)[0], PIXELS)


def test_a_window_beside_the_picture_is_refused(tmp_path):
    path = write(tmp_path / "a.exr", PIXELS, corner=(500, 0))
    with pytest.raises(ValueError, match="outside its display window"):
        read_float_image(path)


@pytest.mark.parametrize(
    "layers, picture",
    [
        ({"": "RGBA", "img": "RGBA"}, ""),
        ({"ViewLayer.Combined": "RGBA", "ViewLayer.Depth": "Z"}, "ViewLayer.Combined"),
        ({"ViewLayer.DiffCol": "RGB", "ViewLayer.Combined": "RGBA"}, "ViewLayer.Combined"),
        ({"main": "rgb", "depth": "Z", "normal": "XYZ"}, "main"),
    ],
)
def test_the_layer_with_the_picture(layers, picture, tmp_path):
    names = [f"{layer}.{channel}".strip(".") for layer, own in layers.items() for channel in own]
    values = np.random.default_rng(1).random((30, 40, len(names))).astype(np.float32)
    found, kinds = read_float_image(write(tmp_path / "a.exr", values, names))
    at = [names.index(f"{picture}.{channel}".strip(".")) for channel in layers[picture]]
    np.testing.assert_array_equal(found, values[..., at])
    assert kinds == layers[picture].upper()


@pytest.mark.parametrize(
    "names, words",
    [
        (
            ["a.R", "a.G", "a.B", "b.R", "b.G", "b.B"],
            "several layers with colours .its channels are a.B, a.G",
        ),
        (["depth.V", "n.X"], "no layer with R, G and B"),
        (["Y", "RY", "BY"], "luminance and chroma"),
    ],
)
def test_layers_that_say_nothing_are_named(names, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        read_float_image(write(tmp_path / "a.exr", np.ones((30, 40, len(names)), np.float32), names))


def test_the_part_with_the_picture(tmp_path):
    depth = OpenEXR.Part(header(), channels(PIXELS, "Z"), "depth")
    beauty = OpenEXR.Part(header(), channels(PIXELS, "RGBA"), "beauty")
    OpenEXR.File([depth, beauty]).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_float_image(tmp_path / "a.exr")[0], PIXELS)


def test_one_channel_of_any_name_is_grey(tmp_path):
    found, names = read_float_image(write(tmp_path / "a.exr", PIXELS, ["Z"]))
    np.testing.assert_array_equal(found, PIXELS[..., :1])
    assert names == "Y"


def test_damaged_files_are_told_without_a_word_of_the_library(tmp_path, capfd):
    path = write(tmp_path / "a.exr", PIXELS)
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises((ValueError, OSError)):
        read_float_image(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("compression", ["NO", "ZIPS", "ZIP", "PIZ", "DWAA", "DWAB", "RLE", "PXR24", "B44"])
def test_rows_that_say_to_be_others_or_longer(compression, tmp_path):
    """Mitsuba's reader ends the process at these, now and then."""
    path = tmp_path / "a.exr"
    pixels = np.tile(np.linspace(0, 1, 300, dtype=np.float32)[:, None], (1, 8))
    with OpenEXR.File(
        {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": OpenEXR.scanlineimage},
        {"Y": pixels},
    ) as file:
        file.write(str(path))
    np.testing.assert_allclose(read_float_image(path)[0][..., 0], pixels, atol=0.01)
    data = bytearray(path.read_bytes())
    offsets = np.frombuffer(bytes(data), "<u8", 2, _end_of_header(data))
    for place in (0, 4):  # the row, and how many bytes follow
        damaged = bytearray(data)
        damaged[offsets[1] + place : offsets[1] + place + 4] = (77_777_777).to_bytes(4, "little")
        path.write_bytes(damaged)
        with pytest.raises((ValueError, OSError, RuntimeError)):
            read_float_image(path)


def _end_of_header(data: bytes) -> int:
    at = 8
    while data[at]:
        at = data.index(0, data.index(0, at) + 1) + 1
        at += 4 + int.from_bytes(data[at : at + 4], "little")
    return at + 1


def test_headers_that_promise_too_much(tmp_path):
    path = write(tmp_path / "a.exr", PIXELS, display=((0, 0), (15999, 15999)))
    with pytest.raises(ValueError, match="nearly all empty"):
        read_float_image(path)


def test_first_pixel_that_is_not_finite():
    pixels = np.zeros((4, 5, 3))
    assert first_not_finite(pixels) is None
    pixels[2, 3, 1] = np.inf
    pixels[3, 0, 0] = np.nan
    assert first_not_finite(pixels) == (3, 2)
