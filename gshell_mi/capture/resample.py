"""Down-scaling by area and removal of lens distortion, on linear premultiplied images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage, sparse

from .camera import Camera, Distortion

#: Pixels that differ by less than this from squares, at the image's edge, count as square.
_SQUARE_TOLERANCE = 0.02


def shrink(image: np.ndarray, camera: Camera, max_size: int) -> tuple[np.ndarray, Camera]:
    """Averages areas so that the longer side becomes ``max_size`` pixels; never enlarges.

    Both axes shrink by the same factor, so square pixels stay square; of the shorter side up to one new
    pixel that the image fills but in part is cut off.

    Args:
        image: (height, width, channels), linear, premultiplied.
        camera: its camera.
        max_size: pixels; 0 leaves the image alone.

    Returns:
        The image and the camera of its new size.

    >>> camera = Camera(4, 4, 5.0, 5.0, 2.0, 2.0, np.eye(4))
    >>> small, half = shrink(np.arange(16.0).reshape(4, 4, 1), camera, 2)
    >>> small[..., 0], half.fx, half.cx
    (array([[ 2.5,  4.5],
           [10.5, 12.5]]), 2.5, 1.0)
    """
    longest = max(camera.width, camera.height)
    if not 0 < max_size < longest:
        return image, camera
    scale = max_size / longest
    # Guard against 3.9999 pixels.
    width, height = (max(int(size * scale + 1e-6), 1) for size in (camera.width, camera.height))
    rows, columns = _area_weights(camera.height, height, scale), _area_weights(camera.width, width, scale)
    channels = image.shape[2]
    image = (rows @ image.reshape(camera.height, -1)).reshape(height, camera.width, channels)
    image = image.transpose(1, 0, 2).reshape(camera.width, -1)
    image = (columns @ image).reshape(width, height, channels).transpose(1, 0, 2)
    small = replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=camera.cx * scale,
        cy=camera.cy * scale,
        rfilter="box",
    )
    return np.ascontiguousarray(image), small


def _area_weights(size: int, new: int, scale: float) -> sparse.csr_array:
    """(new, size) shares that old pixels have in new ones; rows sum to 1."""
    start = np.arange(new) / scale
    reach = int(np.ceil(1 / scale)) + 1
    index = np.floor(start)[:, None].astype(int) + np.arange(reach)
    overlap = np.minimum(index + 1, (start + 1 / scale)[:, None]) - np.maximum(index, start[:, None])
    overlap = np.where(index < size, np.clip(overlap, 0, None), 0)
    row = np.repeat(np.arange(new), reach)
    weights = sparse.csr_array(
        (overlap.ravel().astype(np.float32), (row, np.minimum(index, size - 1).ravel())), shape=(new, size)
    )
    # The last new pixel may end a rounding error beyond the image.
    return sparse.diags_array(1 / weights.sum(axis=1)) @ weights


def rectify(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Resamples to a camera with square pixels and no distortion, as Mitsuba's ``perspective`` is one.

    Size, principal point and the focal length ``fx`` stay. What lies beyond the image's edge repeats it, so
    that an object that the frame cuts off still reaches the frame.

    Returns:
        The image and its camera; both unchanged if there is nothing to do.
    """
    straight = replace(camera, fy=camera.fx, distortion=Distortion())
    if (seen := _seen(camera)) is None:
        return image, straight
    return _sample(image, seen[..., 1] - 0.5, seen[..., 0] - 0.5), straight


def framed(camera: Camera) -> np.ndarray:
    """(height, width) booleans: the pixels of the rectified image that the image of ``camera`` holds."""
    if (seen := _seen(camera)) is None:
        return np.ones((camera.height, camera.width), bool)
    return np.asarray(((seen >= 0) & (seen <= [camera.width, camera.height])).all(axis=-1))


def _seen(camera: Camera) -> np.ndarray | None:
    """(height, width, 2) where ``camera`` shows the centres of the rectified image's pixels; None if that is
    where they are."""
    square = abs(camera.fy / camera.fx - 1) * camera.height <= _SQUARE_TOLERANCE
    if square and not camera.distortion:
        return None
    v, u = np.mgrid[0.5 : camera.height, 0.5 : camera.width]
    ideal = np.stack([u - camera.cx, v - camera.cy], axis=-1) / camera.fx
    # Beyond the fold the polynomial leads back into the image, where that point of the scene is not.
    radius = np.linalg.norm(ideal, axis=-1, keepdims=True)
    ideal *= np.minimum(1.0, 0.999 * camera.distortion.folds_at() / np.maximum(radius, 1e-9))
    return camera.distortion.apply(ideal) * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def _sample(image: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Cubic interpolation at pixel indices, kept within the range of the four pixels around.

    Without that limit it rings at the sharp edge of a mask.
    """
    height, width, channels = image.shape
    rows = [np.clip(np.floor(row).astype(int) + step, 0, height - 1) for step in (0, 1)]
    columns = [np.clip(np.floor(column).astype(int) + step, 0, width - 1) for step in (0, 1)]
    around = np.stack([image[r, c] for r in rows for c in columns])
    cubic = np.stack(
        [
            ndimage.map_coordinates(image[..., c], [row, column], order=3, mode="nearest")
            for c in range(channels)
        ],
        axis=-1,
    )
    return np.clip(cubic, around.min(axis=0), around.max(axis=0))
