"""Outlines of coverage masks, to a fraction of a pixel."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.measure import find_contours

#: Samples per contour segment: the nearest sample is at most 1/8 pixel from the nearest point.
_CONTOUR_SAMPLES = 4
#: Pixels nearer to the outline than this get their distance from the sub-pixel contour.
_NEAR = 6.0
#: Less coverage is taken for noise; beside a sharp edge there is more than the latter.
_FAINT, _FULL = 0.01, 0.75
#: Where more of the pixels around are faint, that is haze and no part of the object.
_HAZE = 0.7
#: Masks are sharp if a tenth of their edges rises by this much from one pixel to the next.
_STEEP = 0.45


def mask_distance(alpha: np.ndarray, *, fill_holes: bool = True) -> np.ndarray:
    """Signed distance to the outline of a coverage mask, negative inside.

    The outline is the level set 1/2 of the coverage, located by linear interpolation between pixel
    centres, so it is accurate to a small fraction of a pixel.

    Args:
        alpha: (height, width) coverage in [0, 1].
        fill_holes: drops outlines that are enclosed by the object. Daylight seen through a garment
            (in at the neck, out at a sleeve) would carve a tunnel through the hull whose walls then
            have to be undone.

    Returns:
        (height, width) distances at the pixel centres, in pixels. An empty mask is +inf everywhere.
    """
    inside = alpha >= 0.5
    if fill_holes:
        filled = ndimage.binary_fill_holes(inside)
        alpha = np.where(filled & ~inside, 1.0, alpha)
        inside = filled
    if not inside.any():
        return np.full(alpha.shape, np.inf)
    # The frame's border is no outline: what it cuts off may go on outside.
    # A film of one row or column is taken for two alike, as there are no cells between its pixels else.
    rows, columns = (int(side < 2) for side in alpha.shape)
    contours = find_contours(np.pad(alpha, ((0, rows), (0, columns)), mode="edge"), 0.5)
    if not contours:
        return np.full(alpha.shape, -np.inf)
    steps = np.linspace(0.0, 1.0, _CONTOUR_SAMPLES, endpoint=False)[:, None, None]
    samples = np.concatenate(
        [((1 - steps) * contour[:-1] + steps * contour[1:]).reshape(-1, 2) for contour in contours]
    )
    # Far from the outline the distance between pixel centres is accurate enough and much cheaper.
    distance = ndimage.distance_transform_edt(inside) + ndimage.distance_transform_edt(~inside) - 0.5
    near = distance < _NEAR
    distance[near] = cKDTree(samples).query(np.argwhere(near))[0]
    return np.where(inside, -distance, distance)


def sharp(alphas: list[np.ndarray]) -> bool:
    """Whether the masks' edges are hardly wider than a pixel, as rendered ones are and mattes may not be."""
    rises = []
    for alpha in alphas:
        down, across = (np.abs(np.diff(alpha, axis=axis, append=alpha.take([-1], axis))) for axis in (0, 1))
        rises.append(np.maximum(down, across)[(alpha > 0.25) & (alpha < 0.75)])
    rises = np.concatenate(rises)
    return len(rises) == 0 or bool(np.percentile(rises, 90) > _STEEP)


def with_thin_parts(alpha: np.ndarray) -> np.ndarray:
    """A coverage mask in which what covers less than half of every pixel around, such as a sheet seen
    edge-on, is a pixel wide. That widens the outlines of masks that are not ``sharp``.

    It is scaled up where none nearby is nearly full, to where the greatest is.
    """
    greatest = ndimage.maximum_filter(alpha, 3)
    thin = (alpha > _FAINT) & (greatest < _FULL)
    thin &= ndimage.uniform_filter(thin.astype(np.float32), 5) < _HAZE
    return np.where(thin, alpha / np.where(thin, greatest, 1), alpha)
