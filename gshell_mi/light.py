"""The environment light that a fit optimises."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from skimage.transform import resize_local_mean

from .compat import environment_data, environment_radiance

#: Radiance below this is raised to it at the start, so that its logarithm exists.
MINIMUM_RADIANCE = 1e-4


def turns_with_camera(sensors: Sequence[mi.Sensor]) -> np.ndarray:
    """Rotations of a light that is fixed to the camera, as where an object turns on a turntable.

    Returns:
        (N, 3, 3) for each sensor the rotation from the world as the first one sees it.
    """
    axes = [
        np.array(mi.traverse(sensor)["to_world"].matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
        for sensor in sensors
    ]
    axes = [matrix / np.linalg.norm(matrix, axis=0) for matrix in axes]
    return np.array([matrix @ axes[0].T for matrix in axes])


def turned(to_world: mi.ScalarTransform4f, turn: np.ndarray) -> mi.Transform4f:
    """``to_world`` of an emitter where the light has turned, by a rotation (3, 3)."""
    rotation = np.eye(4)
    rotation[:3, :3] = turn
    return mi.Transform4f(mi.ScalarTransform4f(rotation) @ to_world)


def turned_for(
    to_world: mi.ScalarTransform4f, first: mi.Sensor, sensors: Sequence[mi.Sensor]
) -> list[mi.Transform4f]:
    """For each sensor ``to_world`` of an emitter that turns with the camera, and is stored as the ``first``
    sensor has it."""
    return [turned(to_world, turn) for turn in turns_with_camera([first, *sensors])[1:]]


class EnvironmentLight:
    """A latitude-longitude environment map whose radiance is the exponential of its parameter.

    The exponential keeps radiance positive and its relative step the same for a dim sky and for a sun;
    a dark texel is never stuck, as it would be at a clamp.

    Args:
        radiance: (height, width, 3) linear Rec.709 radiance to start with.
        to_world: rotation of the map, as an ``envmap`` emitter takes it.

    The optimised parameter is ``log_radiance``, a ``TensorXf`` of the same shape.
    """

    def __init__(self, radiance: np.ndarray, to_world: mi.ScalarTransform4f | None = None):
        floor = np.maximum(radiance, MINIMUM_RADIANCE).astype(np.float32)
        self.log_radiance = mi.TensorXf(np.log(floor))
        self.to_world = to_world or mi.ScalarTransform4f()

    @classmethod
    def uniform(cls, height: int, radiance: float) -> EnvironmentLight:
        """The same radiance from everywhere, ``height`` x ``2 height`` texels."""
        return cls(np.full((height, 2 * height, 3), radiance, np.float32))

    @classmethod
    def from_emitter(cls, emitter: mi.Emitter, height: int) -> EnvironmentLight | None:
        """The light of an ``envmap`` emitter, averaged to ``height`` rows; None for other emitters.

        A ``constant`` emitter says that nothing is known, not even how bright it is.
        """
        parameters = mi.traverse(emitter)
        if "data" not in parameters:
            return None
        radiance = environment_radiance(emitter)
        # A sun may be one texel, also at the map's seam: means over areas lose nothing of it.
        shrunk = resize_local_mean(
            radiance, (height, 2 * height), grid_mode=True, preserve_range=True, channel_axis=-1
        )
        return cls(shrunk, mi.ScalarTransform4f(np.array(parameters["to_world"].matrix).reshape(4, 4)))

    @property
    def radiance(self) -> mi.TensorXf:
        return dr.exp(self.log_radiance)

    def turned(self, turn: np.ndarray) -> mi.Transform4f:
        """``to_world`` of the emitter where the light has turned, by a rotation (3, 3)."""
        return turned(self.to_world, turn)

    @cached_property
    def solid_angles(self) -> mi.TensorXf:
        """(height, 1, 1) of the texels of each row, relative to one at the horizon.

        A gradient divided by these is that of radiance as a function on the sphere: it does not shrink with
        the texels towards the poles.
        """
        height = self.log_radiance.shape[0]
        polar = (np.arange(height, dtype=np.float32) + 0.5) * np.pi / height
        return mi.TensorXf(np.sin(polar)[:, None, None].astype(np.float32))

    def emitter(self) -> mi.Emitter:
        """A new ``envmap`` emitter with the present radiance and the id ``light``."""
        return mi.load_dict(
            {
                "type": "envmap",
                "id": "light",
                "to_world": self.to_world,
                "bitmap": mi.Bitmap(dr.detach(self.radiance)),
                "mis_compensation": False,
            }
        )

    def update(self, parameters: mi.SceneParameters, key: str = "light.data") -> None:
        """Hands the radiance, attached to the parameter, to the emitter behind ``parameters[key]``."""
        parameters[key] = environment_data(self.radiance)
