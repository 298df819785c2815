"""What a mask does not know: wide grey areas, what an ignore mask covers, what lies beside the frame.

Grey at an outline is coverage. A grey area that is wide is somebody's "I cannot tell": the band of a trimap,
a network's doubt, a feathered selection.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..errors import UserError
from .file_names import Copies
from .frames import Capture, Frame
from .masks import mask_of, mask_values, stretched
from .reduced import match_frame

#: Folder that is looked for beside the images.
FOLDER = "ignore"
#: Values between these are grey; JPEG masks are a little off black and white around outlines.
_GREY = (0.1, 0.9)
#: Grey areas narrower than this share of the longer side, and than so many pixels, are coverage.
_WIDE, _WIDE_PIXELS = 0.01, 5


def wide_grey(mask: np.ndarray) -> np.ndarray:
    """(h, w) booleans: the grey areas of a mask (h, w) that are too wide for an outline's coverage.

    >>> mask = np.zeros((40, 40), np.float32)
    >>> mask[:, 20:] = 1
    >>> mask[:, 19] = 0.4           # an outline
    >>> mask[5:15, 5:15] = 0.5      # cannot tell
    >>> int(wide_grey(mask).sum())
    100
    """
    grey = (mask > _GREY[0]) & (mask < _GREY[1])
    width = max(_WIDE_PIXELS, round(_WIDE * max(mask.shape)))
    if grey.sum() < width**2:
        return np.zeros_like(grey)
    # An opening with a square, an axis at a time.
    result = grey
    for smallest in (True, False):
        for axis in (0, 1):
            shift = -1 if width % 2 == 0 and not smallest else 0
            filter = ndimage.minimum_filter1d if smallest else ndimage.maximum_filter1d
            result = filter(
                result.view(np.uint8), width, axis=axis, mode="constant", cval=0, origin=shift
            ).view(bool)
    return result


def assign_ignored(capture: Capture, folder: Path | None) -> Capture:
    """Finds the ignore mask of each frame: named as masks are, white where nothing is known.

    Images without one are known everywhere.

    Args:
        folder: where they are; default: ``ignore`` beside the folder of the images, if there is one.

    Raises:
        UserError: the given folder does not exist, or none of its files is named like an image.
    """
    given = folder is not None
    if given and not folder.is_dir():
        raise UserError(f"Folder '{folder}' does not exist; correct --ignore.")
    folder = folder or capture.frames[0].image.parent.parent / FOLDER
    if not folder.is_dir():
        return capture
    copies = Copies(frame.image.as_posix() for frame in capture.frames)
    found = [copies.find(folder, frame.image.as_posix(), mask_of(frame.image)) for frame in capture.frames]
    if given and not any(found):
        raise UserError(
            f"No file in '{folder}' is named like an image; name each as its image, as in "
            f"'{capture.frames[0].image.stem}.png', or leave out --ignore."
        )
    return replace(
        capture,
        frames=tuple(replace(frame, ignored=file) for frame, file in zip(capture.frames, found, strict=True)),
    )


def read_ignored(frame: Frame, shape: tuple[int, int], reduction: int, white: float = 1.0) -> np.ndarray:
    """(height, width) share of each pixel that a frame's ignore mask covers.

    Args:
        shape, reduction: of the image, as for ``match_size``.
        white: the value that counts as 1, see ``ignored_white_of``.

    Raises:
        UserError: it cannot be read, or has another aspect than its image.
    """
    assert frame.ignored is not None, "the frame has an ignore mask"
    values = stretched(mask_values(frame.ignored), white)
    matched = match_frame(values, frame, shape, reduction)
    if matched is None:
        raise UserError(
            f"Ignore mask '{frame.ignored}' is {values.shape[1]} x {values.shape[0]} pixels, but "
            f"its image is {frame.camera.width} x {frame.camera.height}; resize it."
        )
    return matched
