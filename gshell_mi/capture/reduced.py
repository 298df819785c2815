"""Photographs read no larger than they are needed: JPEG decoders halve an image at a fraction of the time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from ..integer_images import open_image
from .camera import Camera
from .decoding import exif_orientation, read_pixels
from .frames import Frame, same_aspect

_JPEG = (".jpg", ".jpeg")
#: From an image as EXIF orientation shows it to as it is stored: photographs are read as stored, as
#: calibrations see them, but tools that make masks may turn them.
_TURNED_BACK = {
    2: lambda mask: mask[:, ::-1],
    3: lambda mask: np.rot90(mask, 2),
    4: lambda mask: mask[::-1],
    5: lambda mask: mask.swapaxes(0, 1),
    6: lambda mask: np.rot90(mask),
    7: lambda mask: np.rot90(mask, 2).swapaxes(0, 1),
    8: lambda mask: np.rot90(mask, -1),
}


def read_reduced(path: Path, longest: int) -> tuple[np.ndarray, int]:
    """The pixels of an image file, and by how much it was reduced while it was decoded.

    Only JPEG files are, by 2, 4 or 8, to no less than ``longest`` pixels on the longer side. A pixel is then
    the mean of a block of encoded values; what does not fill a block at the right and the bottom is cut off.

    Args:
        path: as for ``read_pixels``.
        longest: 0 reduces nothing.

    Raises:
        UserError: as ``read_pixels``.
    """
    if longest <= 0 or path.suffix.lower() not in _JPEG or not path.is_file():
        return read_pixels(path), 1
    try:
        with open_image(path) as image:
            before = image.size
            reduction = next((r for r in (8, 4, 2) if max(before) >= r * longest), 1)
            if reduction == 1 or image.mode not in ("L", "RGB"):
                return read_pixels(path), 1
            wanted = (before[0] // reduction, before[1] // reduction)
            image.draft(image.mode, wanted)
            if image.size != tuple(-(-size // reduction) for size in before):
                return read_pixels(path), 1
            pixels = np.array(image)[: wanted[1], : wanted[0]]
    except (OSError, SyntaxError, ValueError):
        return read_pixels(path), 1  # which tells what is wrong with the file
    return (np.stack([pixels] * 3, axis=-1) if pixels.ndim == 2 else pixels), reduction


def reduced_camera(camera: Camera, reduction: int) -> Camera:
    """The camera of an image that was reduced by a whole number.

    >>> small = reduced_camera(Camera(9, 8, 8.0, 8.0, 4.5, 4.0, np.eye(4)), 4)
    >>> small.width, small.height, small.fx, small.cx
    (2, 2, 2.0, 1.125)
    """
    if reduction == 1:
        return camera
    return replace(
        camera,
        width=camera.width // reduction,
        height=camera.height // reduction,
        fx=camera.fx / reduction,
        fy=camera.fy / reduction,
        cx=camera.cx / reduction,
        cy=camera.cy / reduction,
    )


def read_reduced_grey(path: Path, size: tuple[int, int], reduction: int) -> np.ndarray | None:
    """A grey 8-bit mask of its image's (width, height), reduced in the file's own type, which is quick.

    Returns:
        (h, w) float32 in [0, 1]; None if the file is of another kind or size, cannot be read, or nothing is
        to be reduced.
    """
    try:
        with open_image(path) as image:
            grey = image.mode in ("1", "L") and "transparency" not in image.info
            if reduction == 1 or image.size != size or not grey:
                return None
            box = (0, 0, size[0] // reduction * reduction, size[1] // reduction * reduction)
            return np.array(image.convert("L").reduce(reduction, box), np.float32) / 255
    except (OSError, SyntaxError, ValueError):
        return None  # reading it in full tells what is wrong


def match_frame(mask: np.ndarray, frame: Frame, shape: tuple[int, int], reduction: int) -> np.ndarray | None:
    """``match_size`` for a mask (h, w) of a frame's image file; one that was turned as the image's EXIF
    orientation tells is turned back."""
    size = (frame.camera.width, frame.camera.height)
    turned_back = _TURNED_BACK.get(exif_orientation(frame.image))
    if frame.turned and turned_back:
        return match_size(turned_back(mask), size, shape, reduction)
    matched = match_size(mask, size, shape, reduction)
    if matched is None and turned_back:
        matched = match_size(turned_back(mask), size, shape, reduction)
    return matched


def match_size(
    mask: np.ndarray, size: tuple[int, int], shape: tuple[int, int], reduction: int
) -> np.ndarray | None:
    """A mask, of its image's size or another of the same aspect, at the size of the reduced image.

    Args:
        mask: (h, w) float32.
        size: (width, height) of the image file.
        shape: (height, width) of its reduced copy.
        reduction: by which it was reduced.

    Returns:
        (height, width) float32; None if its aspect is another.
    """
    height, width = mask.shape
    if (width, height) == size and reduction == 1:
        return mask
    if not same_aspect((width, height), size):
        return None
    scale = np.array([width / size[0], height / size[1]]) * reduction  # mask pixels per pixel
    reach = np.maximum(np.ceil(scale * shape[::-1] - 1e-6).astype(int) - [width, height], 0)
    padded = np.pad(mask, ((0, reach[1]), (0, reach[0])), mode="edge")
    filter = Image.Resampling.BOX if scale.min() >= 1 else Image.Resampling.BILINEAR
    box = (0.0, 0.0, min(scale[0] * shape[1], padded.shape[1]), min(scale[1] * shape[0], padded.shape[0]))
    return np.clip(np.array(Image.fromarray(padded).resize((shape[1], shape[0]), filter, box)), 0.0, 1.0)
