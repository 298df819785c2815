"""Masks that are stored as viewers turn their photographs, where sizes do not tell: upside down, or square.

Photographs are read as they are stored, as calibrations see them. Tools that make masks may honour their EXIF
orientation; which of the two they did shows in whether the masks agree on a common volume.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..wording import counted
from .decoding import exif_orientation
from .frames import Capture, Frame
from .masks import mask_values, stretched
from .reduced import match_frame
from .region import MASK_SIZE, Silhouette, agreement, find_box
from .resample import shrink

#: Views, at most, whose masks are looked at.
_MOST = 40
#: Masks that agree so well are read rightly; another reading has to be better by so much.
_AGREE, _BETTER = 0.9, 0.05


def with_turned_masks(capture: Capture, white: float, inverted: bool) -> tuple[Capture, list[str]]:
    """Finds out whether masks are to be turned back, where their sizes leave that open.

    Args:
        white, inverted: as for ``coverage_of``.

    Returns:
        The capture, of which such frames are marked, and what to tell of it.

    Raises:
        UserError: a mask cannot be read.
    """
    open_ = [frame for frame in capture.frames if frame.mask is not None and _is_open(frame)]
    if not open_:
        return capture, []
    training = capture.training
    some = training[:: max(-(-len(training) // _MOST), 1)]
    marked = {frame.image for frame in open_}
    readings = [
        [replace(frame, turned=turned and frame.image in marked) for frame in some]
        for turned in (False, True)
    ]
    stored, turned = (_agreement(frames, white, inverted) for frames in readings)
    who = f"{counted(len(open_), 'photograph')} such as {open_[0].image.name}"
    if turned > max(_AGREE, stored + _BETTER):
        frames = tuple(replace(frame, turned=frame.image in marked) for frame in capture.frames)
        return replace(capture, frames=frames), [
            f"{who} carry an EXIF orientation, which their masks follow, but not their pixels: the masks are "
            f"turned back."
        ]
    if stored > max(_AGREE, turned + _BETTER):
        return capture, []
    return capture, [
        f"{who} carry an EXIF orientation: their masks must be stored as their pixels are, not "
        f"as viewers turn them."
    ]


def _is_open(frame: Frame) -> bool:
    orientation = exif_orientation(frame.image)
    return orientation in (2, 3, 4) or (orientation > 4 and frame.camera.width == frame.camera.height)


def _agreement(frames: list[Frame], white: float, inverted: bool) -> float:
    """Mean share of the masks that their common volume explains; 0 without one."""
    silhouettes = []
    for frame in frames:
        if frame.mask is None:
            continue
        alpha = match_frame(mask_values(frame.mask), frame, (frame.camera.height, frame.camera.width), 1)
        if alpha is None:  # which is told when the target is made
            continue
        alpha = stretched(alpha, white)
        small, camera = shrink((1 - alpha if inverted else alpha)[..., None], frame.camera, MASK_SIZE)
        silhouette = Silhouette(camera, small[..., 0])
        if not silhouette.is_empty:
            silhouettes.append(silhouette)
    box = find_box(silhouettes) if len(silhouettes) > 2 else None
    return 0.0 if box is None else float(np.mean(agreement(silhouettes, box)))
