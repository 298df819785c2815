"""What relighting scores can and cannot blame a fit for."""

from __future__ import annotations

import numpy as np


def albedo_scale(images: list[np.ndarray], references: list[np.ndarray]) -> np.ndarray:
    """The factor per colour channel, one for all views, that brings the images nearest to the references.

    Images tell the product of albedo and light only. A fit under unknown light is right up to a factor per
    channel, which relighting papers (e.g. NeRFactor, Zhang et al. 2021) divide out before they score; the raw
    score belongs beside it.

    >>> image = np.random.default_rng(0).random((4, 4, 4))
    >>> albedo_scale([image], [image * [2, 3, 4, 1]]).round(6).tolist()
    [2.0, 3.0, 4.0]
    """
    products, squares = np.zeros(3), np.zeros(3)
    for image, reference in zip(images, references, strict=True):
        products += (image * reference)[..., :3].sum((0, 1))
        squares += (image**2)[..., :3].sum((0, 1))
    return products / np.maximum(squares, 1e-12)
