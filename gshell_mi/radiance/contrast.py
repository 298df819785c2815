"""How radiance is compared as long as there is no light model: so that insides in deep shade count."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .. import losses

_CONTRAST = 10.0

#: Targets that are darker are taken to be this bright.
_BLACK = 1e-3


class Contrast:
    """The tone curve ``log(1 + 10 radiance / mean)``, scaled so that its slope at the mean is that of
    ``losses.tonemap``.

    What is a tenth as bright as the mean, like the inside of a garment, weighs four times as much as it does
    with that. Linear in the bright: with a plain logarithm the noise of black pixels would rule.

    Args:
        mean: radiance of the targets.

    >>> tone, h = Contrast(0.5), 1e-2
    >>> slopes = [(tone(x + h) - tone(x - h)) / (2 * h) for x in (mi.Float(0.05), mi.Float(0.5))]
    >>> [f"{slope[0]:.1f}" for slope in slopes]
    ['3.7', '0.7']
    >>> Contrast(0.0)(mi.Float(0))[0]       # all targets are black
    0.0
    """

    def __init__(self, mean: float):
        mean = max(mean, _BLACK)
        self._scale = dr.opaque(mi.Float, _CONTRAST / mean)
        self._unit = dr.opaque(mi.Float, (1 + 1 / _CONTRAST) * mean / (1 + mean))

    def __call__(self, radiance: mi.Color3f | mi.Float) -> mi.Color3f | mi.Float:
        return self._unit * losses.tonemap(self._scale * radiance)
