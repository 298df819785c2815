"""The targets' pixels that may show the object in one buffer, sampled at random across views."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from .targets import Target, mean_radiance
from .views import PinholeViews

#: Coverage of a pixel from which on nothing of the background is in it.
COVERED = 0.99

#: Coverage of a pixel below which it shows the background: the rest is noise.
FAINT = 0.01

#: Radiance, over the mean of what is covered, below which noise and haze have their say.
DARK = 0.1

#: Pixels this near to a mask are drawn, too: a template that is still to move may reach beyond it.
_MARGIN = 3

#: Pixels per side of the tiles that pixels are stored in: those that follow each other are neighbours.
_TILE = 4


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

    def at(self, lane: mi.UInt32) -> PixelSample:
        """The same on some lanes."""
        return PixelSample(
            *(
                dr.gather(type(value), value, lane)
                for value in (self.view, self.film, self.radiance, self.alpha)
            )
        )


class PixelPool:
    """The pixels of targets, whatever their sizes, each equally likely to be drawn.

    All templates lie within the visual hull, so rays far outside the masks meet nothing, and nothing is to be
    learnt from them. On most photographs those are most pixels. They count, but are not drawn. What is
    unknown is not drawn either.

    Args:
        views: the cameras.
        targets: their images.
        chosen: indices of the views whose pixels are drawn; default all.
        off_outline: leaves out pixels nearer to a mask's outline than this many pixels, in views that show
            more of the object than that.
    """

    def __init__(
        self,
        views: PinholeViews,
        targets: list[Target],
        chosen: np.ndarray | None = None,
        off_outline: int = 0,
    ):
        chosen = np.arange(len(views)) if chosen is None else chosen
        targets = [targets[index] for index in chosen]
        places = [_tiled(_drawn(target, off_outline)) for target in targets]
        rgba = np.concatenate([target.rgba[*place.T] for target, place in zip(targets, places, strict=True)])
        self._pixels = mi.Float(rgba.ravel())
        self._view = mi.UInt32(np.repeat(chosen, [len(place) for place in places]))
        row, column = np.concatenate(places).T.astype(np.float32)
        self._corner = mi.Point2f(column, row)
        self._size = mi.Vector2f(views.sizes.T.astype(np.float32))
        self._count = len(row)
        self._share = self._count / int(views.sizes[chosen].prod(axis=1).sum())
        self.has_alpha = all(target.has_alpha for target in targets)
        self._mean_radiance = mean_radiance(targets)

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

    def sample(self, count: int, *, seed: int, step: int, rays: int = 1, together: int = 1) -> PixelSample:
        """What is drawn of ``count`` pixels; the same for the same ``seed`` and ``step``.

        Args:
            count: pixels, of which those far from the masks are left out.
            seed, step: of the random numbers.
            rays: positions per pixel, which follow each other.
            together: neighbours that are drawn together; what they see is near in memory.
        """
        count = max(round(count * self._share / together), 1)
        # One stream per step: a resumed run draws what the uninterrupted one would have drawn.
        random = mi.PCG32(size=count, initstate=dr.opaque(mi.UInt64, seed), initseq=_sequence(count, step))
        most = dr.opaque(mi.UInt32, self._count - 1)
        # A float has too few bits to reach every pixel of many photographs.
        pixel = mi.UInt32((mi.UInt64(random.next_uint32()) * dr.opaque(mi.UInt64, self._count)) >> 32)
        if rays * together > 1:
            lane = dr.arange(mi.UInt32, count * together * rays)
            pixel = dr.gather(mi.UInt32, pixel, lane // (rays * together)) + (lane // rays) % together
            pixel, count = dr.minimum(pixel, most), rays * together * count
            random = mi.PCG32(
                size=count, initstate=dr.opaque(mi.UInt64, seed + 1), initseq=_sequence(count, step)
            )
        view = dr.gather(mi.UInt32, self._view, pixel)
        corner = dr.gather(mi.Point2f, self._corner, pixel)
        film = mi.Point2f(corner + mi.Vector2f(random.next_float32(), random.next_float32()))
        film /= dr.gather(mi.Vector2f, self._size, view)
        rgba = dr.gather(mi.Vector4f, self._pixels, pixel)
        sample = PixelSample(view, film, mi.Color3f(rgba.x, rgba.y, rgba.z), rgba.w)
        dr.eval(sample.view, sample.film, sample.radiance, sample.alpha)
        return sample


def _tiled(chosen: np.ndarray) -> np.ndarray:
    """(n, 2) row and column of the chosen pixels, tile by tile of 4 x 4."""
    place = np.argwhere(chosen)
    row, column = place.T // _TILE
    return place[np.lexsort((column, row))]


def _drawn(target: Target, off_outline: int) -> np.ndarray:
    """(height, width) which pixels may be drawn. Of what is all outline, as a twig is, all are."""
    drawn = _near_object(target) & _known(target)
    inside = drawn & ~_on_outline(target, off_outline)
    return inside if (inside & (target.rgba[..., 3] > 0.5)).any() else drawn


def _near_object(target: Target) -> np.ndarray:
    """(height, width) whether a ray through a pixel may meet the visual hull, which bridges holes."""
    mask = ndimage.binary_fill_holes(target.rgba[..., 3] > FAINT)
    near = ndimage.maximum_filter(mask, 2 * _MARGIN + 1)
    return near if near.any() else np.ones_like(near)


def _known(target: Target) -> np.ndarray:
    """(height, width) whether all of a pixel is known; everywhere if nothing is."""
    known = np.asarray(target.known) > COVERED
    return known if known.any() else np.ones_like(known)


def _on_outline(target: Target, distance: int) -> np.ndarray:
    """(height, width) whether a pixel is within a distance of one that the object covers otherwise."""
    covered = target.rgba[..., 3] > 0.5
    side = 2 * distance + 1
    return ndimage.maximum_filter(covered, side) != ndimage.minimum_filter(covered, side)


def _sequence(count: int, step: int) -> mi.UInt64:
    return dr.opaque(mi.UInt64, step * count) + dr.arange(mi.UInt64, count)
