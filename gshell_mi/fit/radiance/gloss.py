"""The part of a radiance that depends on the view, shared by the whole surface.

Without it a highlight, which moves over the surface as the view does, reads as texture of a surface that lies
deeper: on convex parts the mirrored world seems to be behind them. The lobe is no light model. It is what the
views have in common: an image of the surroundings over the mirrored direction, a curve over the angle of
incidence (Fresnel), and how glossy each vertex is.
"""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

#: Rows of the image of the surroundings; it has twice as many columns.
_HEIGHT = 16

#: Nodes of the curve over the cosine of the angle of incidence.
_NODES = 8

#: Reflectance at normal incidence that the curve starts from (Schlick 1994).
_REFLECTANCE = 0.04

#: Logarithm of the gloss that the back sides start with: they mostly see the object itself.
_BACK_GLOSS = -2.0


PER_SIDE = "gloss"
SHARED = ("fresnel", "surroundings")


def initial_lobe(vertex_count: int, radiance: float) -> dict[str, mi.Float]:
    """The lobe's parameters: logarithms, so that every factor stays positive.

    Args:
        vertex_count: V.
        radiance: mean radiance of the images, which the surroundings start from.

    Returns:
        ``gloss``, (V, 2) of the front and the back of every vertex; ``fresnel``, over the cosine; and
        ``surroundings``, a latitude-longitude image, y up, interleaved colours.
    """
    cosine = np.linspace(0, 1, _NODES)
    schlick = _REFLECTANCE + (1 - _REFLECTANCE) * (1 - cosine) ** 5
    return {
        PER_SIDE: mi.Float(np.tile(np.float32([0, _BACK_GLOSS]), vertex_count)),
        "fresnel": mi.Float(np.log(schlick).astype(np.float32)),
        "surroundings": dr.full(mi.Float, float(np.log(max(radiance, 1e-3))), 3 * 2 * _HEIGHT * _HEIGHT),
    }


def mirrored_radiance(lobe: Mapping[str, mi.Float], gloss: mi.Float, normal: mi.Vector3f,
                      direction: mi.Vector3f) -> mi.Color3f:
    """``gloss * fresnel(cosine) * surroundings(mirrored direction)``: what comes back along a ray.

    Args:
        lobe: the parameters.
        gloss: its logarithm where the ray hits.
        normal: on the side that the ray comes from; unit length.
        direction: of the ray.
    """
    cosine = dr.clip(-dr.dot(normal, direction), 0, 1)
    mirrored = direction + 2 * cosine * normal
    factor = dr.exp(_fresnel(lobe["fresnel"], cosine) + gloss)
    return factor * dr.exp(_surroundings(lobe["surroundings"], mirrored))


def _fresnel(curve: mi.Float, cosine: mi.Float) -> mi.Float:
    position = cosine * (_NODES - 1)
    node = dr.minimum(mi.UInt32(position), _NODES - 2)
    low, high = (dr.gather(mi.Float, curve, node + i) for i in range(2))
    return dr.lerp(low, high, position - node)


def _surroundings(image: mi.Float, direction: mi.Vector3f) -> mi.Color3f:
    width = 2 * _HEIGHT
    v = dr.safe_acos(direction.y) * (_HEIGHT / dr.pi) - 0.5
    u = (dr.atan2(direction.x, direction.z) / dr.two_pi + 0.5) * width - 0.5
    column, row = mi.Int32(dr.floor(u)), mi.Int32(dr.floor(v))

    def texel(x: mi.Int32, y: mi.Int32) -> mi.Color3f:
        x = dr.select(x < 0, x + width, dr.select(x >= width, x - width, x))
        index = dr.clip(y, 0, _HEIGHT - 1) * width + x
        return dr.gather(mi.Color3f, image, mi.UInt32(index))

    upper, lower = (dr.lerp(texel(column, row + i), texel(column + 1, row + i), u - column) for i in range(2))
    return dr.lerp(upper, lower, v - row)
