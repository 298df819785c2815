"""The targets' pixels that may show the object in one buffer, sampled at random across views."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from ...targets import Target
from ...views import PinholeViews

#: Coverage of a pixel from which on nothing of the background is in it.
COVERED = 0.99

#: Coverage of a pixel below which it shows the background: the rest is noise.
FAINT = 0.01

#: Pixels this near to a mask are drawn, too: a template that is still to move may reach beyond it.
_MARGIN = 3


@dataclass(frozen=True)
class PixelSample:
    """Random positions on random films, and the targets there.

    Attributes:
        view: index of the view.
        film: film position in [0, 1]^2, uniform in its pixel.
        radiance, alpha: the pixel's premultiplied colour and coverage.
    """

    view: mi.UInt32
    film: mi.Point2f
    radiance: mi.Color3f
    alpha: mi.Float


class PixelPool:
    """The pixels of targets, whatever their sizes, each equally likely to be drawn.

    All templates lie within the visual hull, so rays far outside the masks meet nothing, and nothing is to be
    learnt from them. On most photographs those are most pixels. They count, but are not drawn.

    Args:
        views: the cameras.
        targets: their images.
        chosen: indices of the views whose pixels are drawn; default all.
    """

    def __init__(self, views: PinholeViews, targets: list[Target], chosen: np.ndarray | None = None):
        chosen = np.arange(len(views)) if chosen is None else chosen
        targets = [targets[index] for index in chosen]
        near = [_near_object(target) for target in targets]
        rgba = np.concatenate([target.rgba[where] for target, where in zip(targets, near, strict=True)])
        self._pixels = mi.Float(rgba.ravel())
        self._view = mi.UInt32(np.repeat(chosen, [np.count_nonzero(where) for where in near]))
        row, column = np.concatenate([np.argwhere(where) for where in near]).T.astype(np.float32)
        self._corner = mi.Point2f(column, row)
        self._size = mi.Vector2f(views.sizes.T.astype(np.float32))
        self._count = len(row)
        self._share = self._count / int(views.sizes[chosen].prod(axis=1).sum())
        self.has_alpha = all(target.has_alpha for target in targets)
        color = sum(float(target.rgba[..., :3].sum(dtype=np.float64)) for target in targets)
        coverage = sum(float(target.rgba[..., 3].sum(dtype=np.float64)) for target in targets)
        self._mean_radiance = color / max(3 * coverage, 1e-6)

    @property
    def share(self) -> mi.Float:
        """Fraction of the pixels that are drawn: a mean over a sample, times this, is one over all."""
        return dr.opaque(mi.Float, self._share)

    def mean_radiance(self) -> float:
        """Mean over the covered pixels and the three channels."""
        return self._mean_radiance

    def mask_weight(self, weight: float) -> float:
        """``weight``, or 0 if a target came without alpha: then coverage is unknown."""
        return weight if self.has_alpha else 0.0

    def sample(self, count: int, *, seed: int, step: int) -> PixelSample:
        """What is drawn of ``count`` pixels; the same for the same ``seed`` and ``step``."""
        count = max(round(count * self._share), 1)
        # One stream per step: a resumed run draws what the uninterrupted one would have drawn.
        random = mi.PCG32(size=count, initstate=dr.opaque(mi.UInt64, seed), initseq=_sequence(count, step))
        most = dr.opaque(mi.UInt32, self._count - 1)
        pixel = dr.minimum(mi.UInt32(random.next_float32() * dr.opaque(mi.Float, self._count)), most)
        view = dr.gather(mi.UInt32, self._view, pixel)
        corner = dr.gather(mi.Point2f, self._corner, pixel)
        film = mi.Point2f(corner + mi.Vector2f(random.next_float32(), random.next_float32()))
        film /= dr.gather(mi.Vector2f, self._size, view)
        rgba = dr.gather(mi.Vector4f, self._pixels, pixel)
        sample = PixelSample(view, film, mi.Color3f(rgba.x, rgba.y, rgba.z), rgba.w)
        dr.eval(sample.view, sample.film, sample.radiance, sample.alpha)
        return sample


def _near_object(target: Target) -> np.ndarray:
    """(height, width) whether a ray through a pixel may meet the visual hull, which bridges holes."""
    mask = ndimage.binary_fill_holes(target.rgba[..., 3] > FAINT)
    near = ndimage.maximum_filter(mask, 2 * _MARGIN + 1)
    return near if near.any() else np.ones_like(near)


def _sequence(count: int, step: int) -> mi.UInt64:
    return dr.opaque(mi.UInt64, step * count) + dr.arange(mi.UInt64, count)
