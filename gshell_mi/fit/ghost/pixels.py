"""All targets' pixels in one buffer, sampled at random across views."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...targets import Target
from ...views import PinholeViews

#: Coverage of a pixel from which on nothing of the background is in it.
COVERED = 0.99


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

    Args:
        views: the cameras.
        targets: their images.
        chosen: indices of the views whose pixels are drawn; default all.
    """

    def __init__(self, views: PinholeViews, targets: list[Target], chosen: np.ndarray | None = None):
        chosen = np.arange(len(views)) if chosen is None else chosen
        targets = [targets[index] for index in chosen]
        counts = views.sizes[chosen].prod(axis=1)
        self._pixels = mi.Float(np.concatenate([target.rgba.ravel() for target in targets]))
        self._view = mi.UInt32(np.repeat(chosen, counts))
        self._width = mi.UInt32(views.sizes[:, 0])
        self._height = mi.UInt32(views.sizes[:, 1])
        first = np.zeros(len(views), np.int64)
        first[chosen] = np.cumsum(counts) - counts
        self._first = mi.UInt32(first)
        self.count = int(counts.sum())
        self.has_alpha = all(target.has_alpha for target in targets)
        color = sum(float(target.rgba[..., :3].sum(dtype=np.float64)) for target in targets)
        coverage = sum(float(target.rgba[..., 3].sum(dtype=np.float64)) for target in targets)
        self._mean_radiance = color / max(3 * coverage, 1e-6)

    def mean_radiance(self) -> float:
        """Mean over the covered pixels and the three channels."""
        return self._mean_radiance

    def mask_weight(self, weight: float) -> float:
        """``weight``, or 0 if a target came without alpha: then coverage is unknown."""
        return weight if self.has_alpha else 0.0

    def sample(self, count: int, *, seed: int, step: int) -> PixelSample:
        """``count`` pixels; the same ones for the same ``seed`` and ``step``."""
        # One stream per step: a resumed run draws what the uninterrupted one would have drawn.
        random = mi.PCG32(size=count, initstate=dr.opaque(mi.UInt64, seed), initseq=_sequence(count, step))
        pixel = dr.minimum(mi.UInt32(random.next_float32() * self.count), self.count - 1)
        view = dr.gather(mi.UInt32, self._view, pixel)
        local = pixel - dr.gather(mi.UInt32, self._first, view)
        width, height = dr.gather(mi.UInt32, self._width, view), dr.gather(mi.UInt32, self._height, view)
        row = local // width
        column = local - row * width
        film = mi.Point2f((column + random.next_float32()) / width, (row + random.next_float32()) / height)
        rgba = dr.gather(mi.Vector4f, self._pixels, pixel)
        sample = PixelSample(view, film, mi.Color3f(rgba.x, rgba.y, rgba.z), rgba.w)
        dr.eval(sample.view, sample.film, sample.radiance, sample.alpha)
        return sample


def _sequence(count: int, step: int) -> mi.UInt64:
    return dr.opaque(mi.UInt64, step * count) + dr.arange(mi.UInt64, count)
