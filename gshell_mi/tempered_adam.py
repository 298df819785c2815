"""Adam whose steps are part of the way from one size per value to one size for all."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .arrays import AnyArray


class TemperedAdam(mi.ad.Adam):
    """Adam that divides by ``(v * max(v))^(1/4)`` with the second moment ``v``: the geometric mean of what
    Adam divides by and what uniform Adam does (Nicolet et al. 2021).

    With one step size per value, what the images tell nothing of walks at random as far as the rest moves;
    with one for all, only the brightest texels of a light with a sun in it move, and of a rim only those
    places where it shows most.
    """

    def _step(
        self, cache: object, value: mi.Float, grad: mi.Float, lr: float, extra: tuple[AnyArray, ...]
    ) -> tuple[mi.Float, tuple[AnyArray, ...]]:
        stepped, extra = super()._step(cache, value, grad, lr, extra)
        second = extra[2]
        share = second / dr.maximum(dr.max(second), 1e-30)
        return dr.fma(dr.sqrt(dr.sqrt(share)), stepped - value, value), extra
