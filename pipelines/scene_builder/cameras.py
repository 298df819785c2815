"""Cameras of the captures that are made of scenes: camera-to-world matrices, axes right, up and backwards."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

#: Ours are y up, the captures' z up.
TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)


def look_at(origin: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The (4, 4) pose of a camera at ``origin`` that looks at ``target`` and stands upright (y up)."""
    backwards = np.asarray(origin, float) - target
    backwards /= np.linalg.norm(backwards)
    right = np.cross([0.0, 1.0, 0.0], backwards)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(backwards, right), backwards, origin], 1)
    return pose


def sensor(pose: np.ndarray, fov: float, size: int) -> mi.Sensor:
    """The square perspective sensor of a pose; ``fov`` in degrees, ``size`` in pixels."""
    # Mitsuba's camera has x to the left and looks along +z.
    to_world = mi.ScalarTransform4f(pose @ np.diag([-1, 1, -1, 1]))
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": fov,
            "to_world": to_world,
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "pixel_format": "rgba",
                "rfilter": {"type": "gaussian"},
            },
        }
    )
