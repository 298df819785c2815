"""An open basket with a bail over its mouth and an ear on either side: three handles, all hollow."""

import numpy as np

from ..files import SceneObject
from ..lights import sunny_sky
from ..modelling import cut, ellipsoid, isosurface, mirrored, relax, smooth_step, smooth_union, torus

STRAW, RED, BROWN = np.array([0.70, 0.50, 0.24]), np.array([0.55, 0.06, 0.05]), np.array([0.24, 0.12, 0.05])


def _trunk(p: np.ndarray) -> np.ndarray:
    """The body, closed: an ellipsoid that stands on a flat foot."""
    return -smooth_union(-ellipsoid(p, [0, -0.22, 0], [0.74, 0.56, 0.62]), p[:, 1] + 0.66, 0.08)


def _handles(p: np.ndarray) -> np.ndarray:
    """The bail's upper half, and both ears."""
    bail = np.maximum(torus(p * [1, 0.85, 1], [0, 0, 0], [0, 0, 1], 0.68, 0.07), -0.15 - p[:, 1])
    q = mirrored(p[:, [2, 1, 0]])
    ears = torus(q, [0.66, -0.2, 0], [0, 0, 1], 0.2, 0.06)
    return np.minimum(bail, ears)


def _closed(p: np.ndarray) -> np.ndarray:
    return smooth_union(_trunk(p), _handles(p), 0.06)


def _mouth(p: np.ndarray) -> np.ndarray:
    """Negative inside the mouth."""
    return ellipsoid(p, [0, 0.26, 0], [0.54, 0.22, 0.47])


def _colour(p: np.ndarray) -> np.ndarray:
    """Woven straw, a red band around it, brown handles."""
    x, y, z = p.T
    weave = np.sin(18 * np.arctan2(z, x)) * np.sin(34 * y)
    color = STRAW * (0.8 + 0.2 * smooth_step(weave, -0.4, 0.4))[:, None]
    for over, distance in ((RED, np.abs(y + 0.2) - 0.09), (BROWN, _handles(p) - 0.03)):
        color = color + (1 - smooth_step(distance, -0.015, 0.015))[:, None] * (over - color)
    return color


def build() -> SceneObject:
    """The basket under a sunny sky."""
    whole = relax(isosurface(_closed, [-0.85, -0.75, -1.0], [0.85, 1.0, 1.0], 0.026), _closed, steps=4)
    mesh = relax(cut(whole, _mouth(np.asarray(whole.vertices))), _closed, _mouth, 10)
    return SceneObject(mesh, _colour(np.asarray(mesh.vertices)), sunny_sky(-25, 48), roughness=0.7)
