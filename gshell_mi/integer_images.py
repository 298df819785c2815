"""Images of 8 and 16 bits, by Pillow, which complains of files that are cut off; PNG of 16 bits besides."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

from .plain_float_images import MOST_PIXELS

#: What is asked whether it knows a file; Pillow has readers that start other programs (EPS).
_FORMATS = ("BMP", "GIF", "JPEG", "PNG", "PPM", "TGA", "TIFF", "WEBP")
#: Beyond this Pillow warns; files with more are refused here before it does worse.
Image.MAX_IMAGE_PIXELS = MOST_PIXELS


def open_image(path: Path) -> Image.Image:
    """``Image.open``, by no reader that starts another program.

    Raises:
        OSError, SyntaxError, ValueError: it is no image, or its header promises absurdly many pixels.
    """
    try:
        image = Image.open(path, formats=_FORMATS)
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from None
    if image.width * image.height > MOST_PIXELS:
        image.close()
        raise ValueError(f"its header promises {image.width} x {image.height} pixels")
    return image


def integer_image_size(path: Path) -> tuple[int, int]:
    """(width, height) by the file's header.

    Raises:
        OSError, ValueError: it is no image.
    """
    with open_image(path) as image:
        return image.size


def read_integer_image(path: Path) -> np.ndarray:
    """The pixels as they are stored: (height, width[, 2 to 4]) of uint8, or uint16 of PNG; palettes and
    transparent colours resolved.

    Raises:
        OSError, SyntaxError, ValueError: it is no image, damaged or cut off.
    """
    with open_image(path) as image:
        image.load()
        if image.format == "PNG" and _is_deep_png(path):
            return np.array(mi.Bitmap(str(path)))
        if "transparency" in image.info or image.mode == "PA":
            image = image.convert("RGBA")
        elif image.mode not in ("L", "LA", "RGB", "RGBA"):
            image = image.convert("RGB")
        return np.array(image)


def _is_deep_png(path: Path) -> bool:
    """Pillow hands out 8 of 16 bits."""
    with open(path, "rb") as file:
        return file.read(25)[24] == 16
