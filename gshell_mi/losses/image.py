"""What an image and its target differ by."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from ..arrays import AnyArray, ArrayT
from ..means import mean, mean_where

#: Keeps relative losses finite in the dark: radiance below this counts as this.
_RELATIVE_FLOOR = 0.01


def tonemap(radiance: ArrayT) -> ArrayT:
    """Logarithmic tone curve ``log(1 + x)``: bright pixels stop dominating; 0 stays 0."""
    return dr.log(1 + dr.maximum(radiance, 0))


def log_l1(image: mi.TensorXf | mi.Color3f, target: mi.TensorXf | mi.Color3f) -> mi.Float:
    """Mean absolute difference of tonemapped radiance, the image loss of nvdiffrec (Munkberg et al. 2022).

    >>> import drjit as dr, mitsuba as mi
    >>> black, bright = mi.TensorXf([0.0, 0.0], (1, 2)), mi.TensorXf([0.0, 1.0], (1, 2))
    >>> f"{log_l1(black, bright)[0]:.4f}"      # log(2) / 2
    '0.3466'
    """
    return mean(dr.abs(tonemap(image) - tonemap(target)))


def smape(image: mi.TensorXf | mi.Color3f, target: mi.TensorXf | mi.Color3f) -> mi.Float:
    """Symmetric mean absolute percentage error ``|a - b| / (|a| + |b| + 0.01)``, between 0 and 1."""
    return mean(dr.abs(image - target) / (dr.abs(image) + dr.abs(target) + _RELATIVE_FLOOR))


def relative_l2(image: mi.TensorXf | mi.Color3f, target: mi.TensorXf | mi.Color3f) -> mi.Float:
    """Mean of ``(a - b)^2 / (b^2 + 0.01)`` with the target b: relative, but blind to what is very dark."""
    return mean(dr.square(image - target) / (dr.square(target) + _RELATIVE_FLOOR))


def l1(image: mi.TensorXf | mi.Color3f, target: mi.TensorXf | mi.Color3f) -> mi.Float:
    """Mean absolute difference of linear radiance: highlights dominate."""
    return mean(dr.abs(image - target))


#: The image losses to choose from, by name.
IMAGE_LOSSES: dict[str, Callable] = {"log_l1": log_l1, "smape": smape, "relative_l2": relative_l2, "l1": l1}


def mask_l2(alpha: AnyArray, target: AnyArray | float) -> mi.Float:
    """Mean squared difference of coverage."""
    return mean(dr.square(alpha - target))


def chroma_difference(first: mi.Color3f, second: mi.Color3f, active: mi.Bool | None = None) -> mi.Float:
    """Mean squared distance of the chromaticities ``c / (r + g + b)`` of two colours.

    Args:
        active: the entries that count; default all.
    """

    def chroma(color: mi.Color3f) -> mi.Color3f:
        return color / dr.maximum(color.x + color.y + color.z, 1e-4)

    squared = dr.squared_norm(chroma(first) - chroma(second))
    return mean(squared) if active is None else mean_where(active, squared)


def depth_l1(distance: mi.Float, target: mi.Float, valid: mi.Bool, limit: float) -> mi.Float:
    """Mean absolute difference of depths where both are known.

    Args:
        distance, target: in the same unit.
        valid: where they can be compared.
        limit: a greater difference counts as this one and has no derivative: there another surface is seen
            than was measured, and no small step mends that.

    >>> import mitsuba as mi
    >>> f"{depth_l1(mi.Float(1, 2, 9), mi.Float(1.5, 2, 1), mi.Bool(True, True, True), limit=1.0)[0]:.3f}"
    '0.500'
    """
    return mean_where(valid, dr.minimum(dr.abs(distance - target), limit))
