"""Which pixels of several images, eight to a byte."""

from __future__ import annotations

import numpy as np


def packed(pixels: list[np.ndarray]) -> np.ndarray:
    """Bytes of (height, width) booleans of each image, one after the other."""
    return np.packbits(np.concatenate([each.ravel() for each in pixels]))


def unpacked(packed_bytes: np.ndarray, sizes: np.ndarray) -> list[np.ndarray]:
    """(height, width) booleans of each image.

    Args:
        packed_bytes: what ``packed`` gave.
        sizes: (N, 2) widths and heights.

    >>> first, second = np.eye(3, dtype=bool), np.ones((2, 5), bool)
    >>> again = unpacked(packed([first, second]), np.array([[3, 3], [5, 2]]))
    >>> (again[0] == first).all() and (again[1] == second).all()
    np.True_
    """
    counts = np.asarray(sizes).prod(axis=1)
    bits = np.unpackbits(packed_bytes, count=int(counts.sum())).astype(bool)
    parts = np.split(bits, np.cumsum(counts)[:-1])
    return [part.reshape(height, width) for part, (width, height) in zip(parts, sizes, strict=True)]
