"""What the warp carries across the borders of pixels, for the box filter.

The box filter is discontinuous, so ``h(T(u) - p)`` has no useful derivative. Instead the pixels stay
where they are, and what flows over their borders is subtracted,

    dI_p = integral over the pixel of (dL + L div V)  -  integral over its border of L V·n,

estimated with samples of their own on the borders near silhouettes. (A warp that keeps the borders in
place is right too, but its divergence near where a silhouette crosses a border has no finite variance.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

if TYPE_CHECKING:
    from .reparameterised_film import Warp


class PixelBorders:
    """Samples on pixel borders that the warp moves.

    Args:
        film: a film with a box filter.
        warp: the ``Warp``.
        count: samples per border.
        sampler: called with a number, returns an independent sampler for as many samples; kept for further
            use.
    """

    def __init__(self, film: mi.Film, warp: Warp, count: int, sampler: Callable[[int], mi.Sampler]) -> None:
        self.width, self.height = (int(n) for n in film.crop_size())
        vertical, horizontal = (self.width + 1) * self.height, self.width * (self.height + 1)
        border = dr.arange(mi.UInt32, vertical + horizontal)
        is_vertical = border < dr.opaque(mi.UInt32, vertical)
        index = dr.select(is_vertical, border, border - dr.opaque(mi.UInt32, vertical))
        columns = dr.opaque(mi.UInt32, self.width) + dr.select(is_vertical, mi.UInt32(1), 0)
        y = index // columns
        x = index - y * columns
        corner = mi.Point2f(mi.Float(x), mi.Float(y))
        middle = corner + dr.select(is_vertical, mi.Vector2f(0, 0.5), mi.Vector2f(0.5, 0))
        step = dr.select(is_vertical, mi.Vector2f(0.5, 0), mi.Vector2f(0, 0.5))
        near = warp.is_near(middle - step) | warp.is_near(middle + step)
        kept = dr.compress(near)
        self.size = dr.width(kept) * count
        if self.size == 0:
            return
        which = dr.gather(mi.UInt32, kept, dr.arange(mi.UInt32, self.size) // dr.opaque(mi.UInt32, count))
        self.sampler = sampler(self.size)
        along = self.sampler.next_1d()
        self.normal, self.u = (dr.gather(mi.Vector2f, dr.ravel(v), which) for v in (2 * step, corner))
        self.u = mi.Point2f(self.u + along * mi.Vector2f(self.normal.y, self.normal.x))
        self.weight = 1 / count
        dr.eval(self.normal, self.u)

    def _pixel(self, side: int) -> tuple[mi.UInt32, mi.Bool]:
        """Pixels before (-1) and after (1) the borders, and whether they lie in the film."""
        p = mi.Point2i(dr.floor(self.u + 0.5 * side * self.normal))
        inside = (p.x >= 0) & (p.x < self.width) & (p.y >= 0) & (p.y < self.height)
        return mi.UInt32(p.y * self.width + p.x), inside

    def flux(self, warp: Warp) -> mi.Float:
        """How fast the borders are crossed; attached."""
        shifted, _ = warp(self.u)
        return dr.dot(self.normal, mi.Vector2f(shifted - self.u)) * self.weight

    def adjoint(
        self, image_adjoint: list[mi.Float], values: list[mi.Float], control: list[mi.Float]
    ) -> mi.Float:
        """Adjoint of the flux. ``values``: the channels on the borders; ``control``: those subtracted
        from the samples inside the pixels, per pixel."""
        total = mi.Float(0)
        for side in (-1, 1):
            pixel, inside = self._pixel(side)
            for g, v, c in zip(image_adjoint, values, control, strict=True):
                contrast = v - dr.gather(mi.Float, c, pixel, inside)
                total += side * dr.gather(mi.Float, g, pixel, inside) * contrast
        return total

    def scatter(
        self, image: list[mi.Float], flux: mi.Float, values: list[mi.Float], control: list[mi.Float]
    ) -> None:
        """Adds the tangent that a flux causes to an image."""
        for side in (-1, 1):
            pixel, inside = self._pixel(side)
            for i, v, c in zip(image, values, control, strict=True):
                contrast = v - dr.gather(mi.Float, c, pixel, inside)
                dr.scatter_add(i, side * flux * contrast, pixel, inside)
        dr.eval(image)
