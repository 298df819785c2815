"""Distances to the outlines of the masks of all views, where points are seen."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from ..views import PinholeViews
from .mask_outline import mask_distance, sharp, with_thin_parts


class MaskDistances:
    """Signed distances to the outlines of the masks of N views, in pixels, negative inside.

    Args:
        views: the cameras.
        alphas: per view, (height, width) coverage.

    Attributes:
        views: as given.
        plain: (P,) at the centres of the pixels of all views, row by row, one view after the other.
        filled: the same as if the masks had no holes; ``plain`` itself if none of them has.
    """

    def __init__(self, views: PinholeViews, alphas: list[np.ndarray]):
        self.views = views
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            thin = list(pool.map(with_thin_parts, alphas)) if sharp(alphas) else alphas
            found = list(pool.map(_distances, thin))
        self.plain = mi.Float(np.concatenate([plain for plain, _ in found]))
        holes = any(filled is not plain for plain, filled in found)
        self.filled = mi.Float(np.concatenate([filled for _, filled in found])) if holes else self.plain
        self._first = mi.UInt32(np.concatenate([[0], np.cumsum(views.sizes.prod(axis=1))[:-1]]))
        self._size = mi.UInt32(views.sizes.ravel())
        self._whole = mi.Bool([not _touches_border(alpha) for alpha in alphas])

    def at(self, distances: mi.Float, view: mi.UInt32, film: mi.Point2f) -> mi.Float:
        """Distances in the pixels of all views, interpolated bilinearly at film positions of some of them."""
        width, height = (dr.gather(mi.UInt32, self._size, 2 * view + axis) for axis in range(2))
        x, y = film.x * width - 0.5, film.y * height - 0.5
        corner = [
            dr.clip(mi.Int32(dr.floor(dr.detach(value))), 0, dr.maximum(mi.Int32(side) - 2, 0))
            for value, side in ((x, width), (y, height))
        ]
        across, down = (dr.clip(value - low, 0, 1) for value, low in zip((x, y), corner, strict=True))
        first = dr.gather(mi.UInt32, self._first, view) + mi.UInt32(corner[1]) * width + mi.UInt32(corner[0])
        right, below = dr.select(width > 1, 1, 0), dr.select(height > 1, width, 0)
        texel = [dr.gather(mi.Float, distances, first + step) for step in (0, right, below, below + right)]
        return dr.lerp(dr.lerp(texel[0], texel[1], across), dr.lerp(texel[2], texel[3], across), down)

    def cone_distance(self, distances: mi.Float, view: mi.UInt32, points: mi.Point3f) -> mi.Float:
        """Distance of points to the cone over a view's mask, to first order, in world units.

        Where the view does not frame a point it is -inf. Unless the mask keeps clear of the frame's border:
        then the view shows the whole object, and it is that at the border, and behind the camera that to
        the cone's apex.
        """
        film, depth = self.views.project(view, points)
        distance = self.at(distances, view, film) * depth * self.views.pixel_size(view)
        behind = dr.norm(points - self.views.origins_of(view))
        framed = (depth > 0) & (film.x >= 0) & (film.x <= 1) & (film.y >= 0) & (film.y <= 1)
        whole = dr.gather(mi.Bool, self._whole, view)
        return dr.select(whole, dr.select(depth > 0, distance, behind), dr.select(framed, distance, -dr.inf))


def _distances(alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those of one mask, (P,), as it is and with its holes filled; the same array if it has none."""
    # Finite next to an empty mask, or interpolation would give NaN.
    diagonal, inside = float(np.hypot(*alpha.shape)), alpha >= 0.5
    plain = mask_distance(alpha, fill_holes=False).clip(-diagonal, diagonal).astype(np.float32).ravel()
    if (ndimage.binary_fill_holes(inside) == inside).all():
        return plain, plain
    return plain, mask_distance(alpha).clip(-diagonal, diagonal).astype(np.float32).ravel()


def _touches_border(alpha: np.ndarray) -> bool:
    return bool(max(alpha[[0, -1]].max(), alpha[:, [0, -1]].max()) >= 0.5)
