"""Which value of masks stands for the object: 255 as a rule, but 200, 128 or the label 1 with some tools."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .decoding import read_pixels
from .frames import Frame
from .masks import alpha_values, mask_values

#: Masks that reach this have a white; a rounded one may miss 1 by a little.
FULL = 0.95
#: So many masks, spread evenly, tell the white of all.
_LOOKED_AT = 8
#: Values within this share of the largest are an object of one grey, but for the noise of a JPEG.
_SAME = 0.9
#: Masks whose values are whole numbers up to this number parts: whatever is not 0 is the object.
_MOST_PARTS = 20


def white_of(frames: Sequence[Frame]) -> float:
    """The value, in [0, 1], that masks or the alpha of images have on the object.

    Alpha of floating point images is as it is, as their colours are premultiplied by it.

    Args:
        frames: of one capture, with the masks that they will be cut out with.

    Raises:
        UserError: a file cannot be read.
    """
    return _common_white(
        lambda frame: (
            mask_values(frame.mask) if frame.mask is not None else alpha_values(read_pixels(frame.image))
        ),
        frames,
    )


def ignored_white_of(frames: Sequence[Frame]) -> float:
    """The same for what ignore masks cover."""
    return _common_white(
        lambda frame: mask_values(frame.ignored) if frame.ignored is not None else None,
        [frame for frame in frames if frame.ignored is not None],
    )


def _common_white(read: Callable[[Frame], np.ndarray | None], frames: Sequence[Frame]) -> float:
    """1, unless the masks agree on a smaller value, which is that of most of what they cover: feathered masks
    and a single faint one are as they are. Of masks that number parts, the smallest number."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_LOOKED_AT, len(frames))).round().astype(int))
    found, labels = [], []
    for values in (read(frames[index]) for index in chosen):
        top = 1.0 if values is None else float(values.max(initial=0))
        if values is None or not top < FULL:
            return 1.0
        if top <= 0:
            continue
        if _numbers_parts(values):
            labels.append(float(values[values > 0].min()))
            continue
        if (values > _SAME * top).sum() < 0.5 * (values > 0.5 * top).sum():
            return 1.0
        found.append(top)
    if labels:
        return 1.0 if found else min(labels)
    return max(found) if found and min(found) > _SAME * max(found) else 1.0


def _numbers_parts(values: np.ndarray) -> bool:
    """Whether values in [0, 1] are whole numbers up to ``_MOST_PARTS`` in a file of 8 or 16 bits."""
    numbers = (scale * np.unique(values) for scale in (255, 65535))
    return any(
        each[-1] < _MOST_PARTS + 0.5 and np.allclose(each, each.round(), rtol=0, atol=1e-3)
        for each in numbers
    )
