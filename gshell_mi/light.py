"""The environment light that a fit optimises."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .compat import environment_data

#: Radiance below this is raised to it at the start, so that its logarithm exists.
MINIMUM_RADIANCE = 1e-4


class EnvironmentLight:
    """A latitude-longitude environment map whose radiance is the exponential of its parameter.

    The exponential keeps radiance positive and its relative step the same for a dim sky and for a sun;
    a dark texel is never stuck, as it would be at a clamp.

    Args:
        radiance: (height, width, 3) linear Rec.709 radiance to start with.

    The optimised parameter is ``log_radiance``, a ``TensorXf`` of the same shape.
    """

    def __init__(self, radiance: np.ndarray):
        floor = np.maximum(radiance, MINIMUM_RADIANCE).astype(np.float32)
        self.log_radiance = mi.TensorXf(np.log(floor))

    @classmethod
    def uniform(cls, height: int, radiance: float) -> EnvironmentLight:
        """The same radiance from everywhere, ``height`` x ``2 height`` texels."""
        return cls(np.full((height, 2 * height, 3), radiance, np.float32))

    @property
    def radiance(self) -> mi.TensorXf:
        return dr.exp(self.log_radiance)

    def emitter(self) -> mi.Emitter:
        """A new ``envmap`` emitter with the present radiance and the id ``light``."""
        return mi.load_dict({"type": "envmap", "id": "light",
                             "bitmap": mi.Bitmap(dr.detach(self.radiance)), "mis_compensation": False})

    def update(self, parameters: mi.SceneParameters, key: str = "light.data") -> None:
        """Hands the radiance, attached to the parameter, to the emitter behind ``parameters[key]``."""
        parameters[key] = environment_data(self.radiance)

    def solid_angle_weights(self) -> mi.TensorXf:
        """(height, width, 1) share of each texel in the sphere; they add up to 1."""
        height, width, _ = self.log_radiance.shape
        row = np.sin((np.arange(height) + 0.5) * np.pi / height)
        weights = np.repeat(row[:, None, None], width, axis=1)
        return mi.TensorXf((weights / weights.sum()).astype(np.float32))
