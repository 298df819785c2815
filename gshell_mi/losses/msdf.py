"""Regularisers of the manifold signed distance field ν: where the surface ends.

A hole too small to be seen through gets no derivative from any image. These terms make holes appear so that
images can judge them, and close the ones that images keep open for no reason (Liu et al., "Ghost on the
Shell", ICLR 2024).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..means import mean, mean_where

#: How far below or above 0 the regularisers pull ν, in its unit: enough to change the sign.
EPSILON = 0.03


def hole_opening(msdf: mi.Float, epsilon: float = EPSILON) -> mi.Float:
    """Mean of ``huber(max(ν, -epsilon) + epsilon)``: pulls the ν of the surface below 0.

    Args:
        msdf: ν at the template's vertices, in cells. Below ``-epsilon`` it is left alone.

    >>> import mitsuba as mi
    >>> f"{hole_opening(mi.Float(1.5, -0.5), epsilon=0.5)[0]:.2f}"      # (2 - 1/2, 0) / 2
    '0.75'
    """
    return mean(_huber(dr.maximum(msdf, -epsilon) + epsilon)) if dr.width(msdf) else mi.Float(0)


def hole_closing(msdf: mi.Float, visible: mi.Bool, epsilon: float = EPSILON) -> mi.Float:
    """Mean of ``huber(min(ν, epsilon) - epsilon)`` over the boundary that is seen: pulls holes shut.

    Args:
        msdf: ν at the boundary's vertices, in cells; 0 there, and attached to the field.
        visible: which of them a view sees. A boundary that nobody sees says nothing.
    """
    return mean_where(visible, _huber(dr.minimum(msdf, epsilon) - epsilon)) if dr.width(msdf) else mi.Float(0)


def visible_outside(msdf: mi.Float, alpha: mi.Float) -> mi.Float:
    """Mean of ``(1 - alpha) max(ν, 0)`` over pixels: what is seen outside the mask has to go.

    Args:
        msdf: ν where a pixel's ray meets the template first; 0 if it does not.
        alpha: the mask's coverage.
    """
    return mean((1 - alpha) * dr.maximum(msdf, 0))


def visible_inside(msdf: mi.Float, alpha: mi.Float, covered: mi.Bool) -> mi.Float:
    """Mean of ``alpha max(-ν, 0)`` over pixels, 0 where the surface is seen: holes where the mask has none.

    Args:
        msdf: ν where a pixel's ray meets the template first; 0 if it does not.
        alpha: the mask's coverage.
        covered: pixels whose ray meets the surface, as holes may be seen through to it.
    """
    return mean(dr.select(covered, 0, alpha * dr.maximum(-msdf, 0)))


def _huber(x: mi.Float) -> mi.Float:
    size = dr.abs(x)
    return dr.select(size < 1, 0.5 * dr.square(x), size - 0.5)
