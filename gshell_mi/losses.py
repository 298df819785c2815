"""Losses as named functions of Dr.Jit arrays; each returns one number (a width-1 ``mi.Float``)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .extraction.surface_mesh import gather


def tonemap(radiance):
    """Logarithmic tone curve ``log(1 + x)``: bright pixels stop dominating; 0 stays 0."""
    return dr.log(1 + dr.maximum(radiance, 0))


def log_l1(image: mi.TensorXf | mi.Color3f, target: mi.TensorXf | mi.Color3f) -> mi.Float:
    """Mean absolute difference of tonemapped radiance, the image loss of nvdiffrec (Munkberg et al. 2022).

    >>> import drjit as dr, mitsuba as mi
    >>> black, bright = mi.TensorXf([0.0, 0.0], (1, 2)), mi.TensorXf([0.0, 1.0], (1, 2))
    >>> f"{log_l1(black, bright)[0]:.4f}"      # log(2) / 2
    '0.3466'
    """
    return _mean(dr.abs(tonemap(image) - tonemap(target)))


def mask_l2(alpha, target) -> mi.Float:
    """Mean squared difference of coverage."""
    return _mean(dr.square(alpha - target))


def binary_entropy_bound(alpha) -> mi.Float:
    """Mean of ``4 a (1 - a)``: 0 where opacity has decided, 1 at one half."""
    return _mean(4 * alpha * (1 - alpha))


def transparency(alpha) -> mi.Float:
    """Mean of ``1 - a``: the pressure that closes what the images leave undecided."""
    return _mean(1 - alpha)


def chroma_difference(first: mi.Color3f, second: mi.Color3f) -> mi.Float:
    """Mean squared distance of the chromaticities ``c / (r + g + b)`` of two radiances."""
    def chroma(color):
        return color / dr.maximum(color.x + color.y + color.z, 1e-4)

    return _mean(dr.squared_norm(chroma(first) - chroma(second)))


def edge_smoothness(values: mi.Color3f | mi.Float, faces: mi.Vector3u) -> mi.Float:
    """Mean absolute difference of vertex values along the faces' edges."""
    corners = [gather(type(values), values, faces[i]) for i in range(3)]
    return sum(_mean(dr.abs(corners[i] - corners[i - 1])) for i in range(3)) / 3


def grey_world(radiance: mi.Color3f) -> mi.Float:
    """Mean distance of a light's radiance from its own grey: nvdiffrec's white-light prior."""
    grey = (radiance.x + radiance.y + radiance.z) / 3
    return _mean(dr.abs(radiance - mi.Color3f(grey)))


def _mean(x) -> mi.Float:
    """Mean over every entry of an array, colour or tensor."""
    flat = dr.ravel(x) if not dr.is_tensor_v(x) else x.array
    return dr.mean(flat) if dr.depth_v(flat) == 1 else flat
