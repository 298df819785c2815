"""Priors of an environment map."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..extraction.surface_mesh import gather
from ..means import mean


def grey_world(radiance: mi.Color3f) -> mi.Float:
    """Mean distance of a light's radiance from its own grey: nvdiffrec's white-light prior."""
    grey = (radiance.x + radiance.y + radiance.z) / 3
    return mean(dr.abs(radiance - mi.Color3f(grey)))


def light_smoothness(log_radiance: mi.TensorXf) -> mi.Float:
    """Mean absolute difference between neighbouring texels of a map's logarithm.

    The logarithm lets a sun be as bright as it likes and only asks where it ends. Columns wrap around.

    Args:
        log_radiance: (height, width, 3).

    >>> import numpy as np, mitsuba as mi
    >>> stripes = np.zeros((4, 8, 3), np.float32)
    >>> stripes[:, ::2] = 1
    >>> light_smoothness(mi.TensorXf(stripes))[0]
    1.0
    """
    height, width, channels = log_radiance.shape
    values = log_radiance.array
    index = dr.arange(mi.UInt32, height * width * channels)
    row, column = index // (width * channels), (index // channels) % width
    right = dr.select(column + 1 < width, index + channels, index - (width - 1) * channels)
    below = dr.select(row + 1 < height, index + width * channels, index)
    across, down = (dr.abs(values - gather(mi.Float, values, other)) for other in (right, below))
    # The last row has nothing below it.
    return mean(across) + dr.sum(down) / ((height - 1) * width * channels)
