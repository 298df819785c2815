"""TIFF: also floating point, and colour that is already multiplied by alpha."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile

from ..integer_images import read_integer_image
from ..plain_float_images import MOST_PIXELS

SUFFIXES = (".tif", ".tiff")


def tiff_size(path: Path) -> tuple[int, int]:
    """(width, height) of the first picture in a TIFF file."""
    with tifffile.TiffFile(path) as file:
        size = int(file.pages.first.imagewidth), int(file.pages.first.imagelength)
    if min(size) < 1 or size[0] * size[1] > MOST_PIXELS:
        raise ValueError(f"its header promises {size[0]} x {size[1]} pixels")
    return size


def read_tiff(path: Path) -> np.ndarray:
    """The pixels of the first picture, (height, width[, channels]), with alpha not yet multiplied in.

    Colour that the file stores multiplied by alpha (ExtraSamples 1) is divided by it; of 8 bits, the result
    has 16, as dark edges would lose theirs. What tifffile unpacks only with a package of its own (LZW, JPEG,
    facsimile), and 1 bit, Pillow reads up to 8 bits.
    """
    with tifffile.TiffFile(path) as file:
        page = file.pages.first
        unpacked = page.compression in tifffile.TIFF.DECOMPRESSORS
        if page.bitspersample < 8 or (page.bitspersample == 8 and not unpacked):
            return read_integer_image(path)
        pixels = page.asarray()
        if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and pixels.ndim == 3:
            pixels = np.moveaxis(pixels, 0, -1)
        if page.photometric == tifffile.PHOTOMETRIC.PALETTE:
            pixels = np.moveaxis(np.asarray(page.colormap), 0, -1)[pixels]
        elif page.photometric == tifffile.PHOTOMETRIC.MINISWHITE and pixels.dtype.kind == "u":
            pixels = np.iinfo(pixels.dtype).max - pixels
        elif page.photometric not in (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB):
            kind = getattr(page.photometric, "name", page.photometric)  # a number, if no kind has it
            raise ValueError(f"its colours are stored as {kind}")
        associated = tifffile.EXTRASAMPLE.ASSOCALPHA in page.extrasamples
    return _unassociated(pixels) if associated and pixels.ndim == 3 else pixels


def _unassociated(pixels: np.ndarray) -> np.ndarray:
    color, alpha = pixels[..., :-1].astype(np.float64), pixels[..., -1:].astype(np.float64)
    straight = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
    if pixels.dtype.kind == "f":
        return np.concatenate([straight, alpha], axis=-1).astype(pixels.dtype)
    top = np.iinfo(pixels.dtype).max
    unit = np.concatenate([straight.clip(0, 1), alpha / top], axis=-1)
    return np.round(unit * 65535).astype(np.uint16)
