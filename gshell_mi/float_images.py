"""Floating point images from files: OpenEXR in its display window and its layer of colour, Radiance HDR, PFM,
and those of 8 and 16 bits. Mitsuba's readers, which trust what a file promises, see none of them first."""

from __future__ import annotations

import os
from pathlib import Path

import Imath
import mitsuba as mi
import numpy as np
import OpenEXR

from .compat import without_chatter
from .integer_images import integer_image_size, read_integer_image
from .plain_float_images import (
    MOST_PIXELS,
    float_map_size,
    is_float_map,
    is_radiance,
    radiance_size,
    read_float_map,
    read_radiance,
)

_EXR_MAGIC = b"\x76\x2f\x31\x01"
#: First bytes of what Mitsuba reads besides: Radiance, PFM, PPM, PNG, JPEG and BMP. TGA it reads unchecked.
_MITSUBA_KINDS = (b"#?", b"PF", b"Pf", b"P6", b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"BM")
#: Rows that are packed together, by the compression's number: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A,
#: DWAA, DWAB.
_ROWS = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)
#: Flags of files with other than one part of rows: tiles, deep pixels or several parts.
_NO_ROWS = 0x1A00
#: Windows and sizes beyond these shares of each other come from damaged headers.
_MOST_EMPTY, _MOST_PACKED = 100, 1 << 14
#: What programs call the layer with the picture, if several layers have colours.
_PICTURES = ("combined", "beauty", "rgba", "rgb")


def is_exr(path: Path) -> bool:
    """Whether a file is OpenEXR by its first bytes, whatever its name."""
    with open(path, "rb") as file:
        return file.read(4) == _EXR_MAGIC


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of the image that ``read_float_image`` returns.

    Raises:
        ValueError, OSError, RuntimeError: the file is no image; the last line says why.
    """
    if not is_exr(path):
        kinds = ((is_radiance, radiance_size), (is_float_map, float_map_size))
        return next((size for is_kind, size in kinds if is_kind(path)), integer_image_size)(path)
    file = _open(path, header_only=True)
    return _size(file.parts[_picture(file, path)[0]].header["displayWindow"])


def read_float_image(path: Path) -> tuple[np.ndarray, str]:
    """The pixels of an image file, linear where the file is of 8 or 16 bits.

    Of an OpenEXR file, the display window is returned: what the data window has beyond it (overscan) is
    left out, and what it lacks is 0. The picture is the unnamed layer, else the only one with colours, else
    the one called Combined, beauty or RGBA; a single channel of any name is grey.

    Returns:
        (height, width, channels) float32, and the channels: ``RGBA``, ``RGB``, ``YA`` or ``Y``.

    Raises:
        ValueError, OSError, RuntimeError: the file is no such image; the last line says why.
    """
    if is_radiance(path):
        return read_radiance(path), "RGB"
    if is_float_map(path):
        pixels = read_float_map(path)
        return pixels, "RGB" if pixels.shape[2] == 3 else "Y"
    if not is_exr(path):
        return _linear_integers(path)
    file = _open(path, header_only=True)
    number, channels = _picture(file, path)
    display, data = (file.parts[number].header[window] for window in ("displayWindow", "dataWindow"))
    width, height = _size(display)
    (x, y), (right, bottom) = ((int(at) for at in corner - display[0]) for corner in data)
    pixels = np.zeros((height, width, len(channels)), np.float32)
    rows, columns = slice(max(y, 0), min(bottom + 1, height)), slice(max(x, 0), min(right + 1, width))
    if rows.start >= rows.stop or columns.start >= columns.stop:
        raise ValueError("its data window lies outside its display window")
    with without_chatter():
        stored = _stored(path, number, list(channels.values()))
    for index, (name, values) in enumerate(stored.items()):
        if values.size != (bottom + 1 - y) * (right + 1 - x):
            raise ValueError(f"its channel {name} is stored at another resolution")
        values = values.reshape(bottom + 1 - y, right + 1 - x)
        pixels[rows, columns, index] = values[
            rows.start - y : rows.stop - y, columns.start - x : columns.stop - x
        ]
    return pixels, "".join(channels)


def check_for_mitsuba(path: Path) -> None:
    """Makes sure that Mitsuba itself can read an image that is not OpenEXR, however it is damaged.

    Raises:
        ValueError, OSError, SyntaxError: it is damaged, or Mitsuba's reader of its kind trusts every file.
    """
    with open(path, "rb") as file:
        start = file.read(8)
    if not start.startswith(_MITSUBA_KINDS):
        raise ValueError("it is of no kind that Mitsuba reads safely")
    read_float_image(path)


def first_not_finite(pixels: np.ndarray) -> tuple[int, int] | None:
    """(column, row) of the first pixel with NaN or infinity; None if all of (h, w, c) are finite."""
    bad = ~np.isfinite(pixels).all(axis=-1)
    if not bad.any():
        return None
    row, column = np.argwhere(bad)[0]
    return int(column), int(row)


def _linear_integers(path: Path) -> tuple[np.ndarray, str]:
    pixels = read_integer_image(path)
    bitmap = mi.Bitmap(pixels.reshape(*pixels.shape[:2], -1))
    bitmap.set_srgb_gamma(True)
    linear = np.array(bitmap.convert(bitmap.pixel_format(), mi.Struct.Type.Float32, False))
    linear = linear.reshape(*pixels.shape[:2], -1)
    return linear, ("Y", "YA", "RGB", "RGBA")[linear.shape[2] - 1]


def _open(path: Path, *, header_only: bool) -> OpenEXR.File:
    with without_chatter():
        file = OpenEXR.File(str(path), separate_channels=True, header_only=header_only)
    if not file.parts:
        raise ValueError("it is damaged")
    return file


def _stored(path: Path, number: int, names: list[str]) -> dict[str, np.ndarray]:
    """The values of channels of one part, in the order of the file's pixels."""
    if number > 0:
        part = _open(path, header_only=False).parts[number]
        return {name: np.asarray(part.channels[name].pixels, np.float32) for name in names}
    # The older interface knows the first part only, but says what is wrong with it, and does not print it.
    file = OpenEXR.InputFile(str(path))
    if not file.isComplete():
        raise ValueError("it is cut off")
    _check_rows(path, file.header())
    read = file.channels(names, Imath.PixelType(Imath.PixelType.FLOAT))
    return {name: np.frombuffer(values, np.float32) for name, values in zip(names, read, strict=True)}


def _check_rows(path: Path, header: dict) -> None:
    """Whether the rows of a file are where its table says, and packed into no more than they are.

    Newer readers take what is there instead. Mitsuba's raises an exception in one of its threads, which now
    and then ends the process.

    Args:
        path: of a file of one part.
        header: of it, as the library's older interface gives it.

    Raises:
        ValueError: they are not.
    """
    data, compression, window = path.read_bytes(), header["compression"].v, header["dataWindow"]
    if compression >= len(_ROWS) or int.from_bytes(data[4:8], "little") & _NO_ROWS:
        return
    step = _ROWS[compression]
    at = 8
    while data[at]:  # name and type of an attribute, which end with a 0, and the size of its value
        for _ in range(2):
            at = data.index(0, at) + 1
        at += 4 + int.from_bytes(data[at : at + 4], "little")
    rows = np.arange(window.min.y, window.max.y + 1, step)
    table = np.frombuffer(data, "<u8", len(rows), at + 1)
    if table.max() > len(data) - 8:
        raise ValueError("it is damaged")
    places = table.astype(np.int64)[:, None] + np.arange(8)
    row, length = np.frombuffer(data, np.uint8)[places].copy().view("<i4").T
    pixel = sum(2 if channel.type.v == Imath.PixelType.HALF else 4 for channel in header["channels"].values())
    most = step * (window.max.x - window.min.x + 1) * pixel
    if (row != rows).any() or (length < 0).any() or (length > most).any():
        raise ValueError("it is damaged")


def _size(window: tuple[np.ndarray, np.ndarray]) -> tuple[int, int]:
    width, height = (int(high) - int(low) + 1 for low, high in zip(*window, strict=True))
    if min(width, height) < 1:
        raise ValueError("its window is empty")
    if width * height > MOST_PIXELS:
        raise ValueError(f"its header promises {width} x {height} pixels")
    return width, height


def _picture(file: OpenEXR.File, path: Path) -> tuple[int, dict[str, str]]:
    """The number of the part with the picture, and the names that its channels R, G, B, A or Y, A have."""
    layers: dict[tuple[int, str], dict[str, str]] = {}
    for number, part in enumerate(file.parts):
        for channel in part.header["channels"]:
            layer, _, name = channel.name.rpartition(".")
            layers.setdefault((number, layer), {})[name.upper()] = channel.name
    chosen = _chosen(layers, [part.name() for part in file.parts])
    part = file.parts[chosen[0]]
    display, data = (_size(part.header[window]) for window in ("displayWindow", "dataWindow"))
    if display[0] * display[1] > max(_MOST_EMPTY * data[0] * data[1], 1 << 22):
        raise ValueError(f"its display window of {display[0]} x {display[1]} pixels is nearly all empty")
    stored = 4 * data[0] * data[1]
    if stored > _MOST_PACKED * os.path.getsize(path):
        raise ValueError(f"its header promises {data[0]} x {data[1]} pixels, for which it is too short")
    if part.type() not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise ValueError("it is a deep image; flatten it")
    names = layers[chosen]
    if "R" in names:
        return chosen[0], {name: names[name] for name in "RGBA" if name in names}
    grey = "Y" if "Y" in names else next(iter(names))
    return chosen[0], {"Y": names[grey]} | ({"A": names["A"]} if "A" in names and grey != "A" else {})


def _chosen(layers: dict[tuple[int, str], dict[str, str]], parts: list[str]) -> tuple[int, str]:
    colored = [key for key, names in layers.items() if {"R", "G", "B"} <= names.keys()]
    if (0, "") in colored:
        return 0, ""
    if len(colored) > 1:
        called = {key: f"{parts[key[0]]}.{key[1]}".strip(".").rpartition(".")[2].lower() for key in colored}
        pictures = [key for name in _PICTURES for key in colored if called[key] == name]
        colored = pictures[:1] or colored
    if len(colored) == 1:
        return colored[0]
    if not colored and {"Y", "RY", "BY"} <= layers.get((0, ""), {}).keys():
        raise ValueError("it stores luminance and chroma (Y, RY, BY) in place of R, G, B")
    if not colored and "Y" in layers.get((0, ""), {}):
        return 0, ""
    if sum(len(names) for names in layers.values()) == 1:
        return next(iter(layers))
    names = ", ".join(sorted(name for found in layers.values() for name in found.values())[:12])
    what = "several layers with colours" if colored else "no layer with R, G and B"
    raise ValueError(f"it has {what} (its channels are {names}); write the one you mean by itself")
