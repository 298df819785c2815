"""A chair that is only seen from above: its seat is a single layer, its legs are closed down to their feet.

No view sees the underside of the seat, and the truth has none: its rim runs below the seat's edge and around
the inner sides of the legs.
"""

import numpy as np

from ..files import SceneObject
from ..lights import sunny_sky
from ..modelling import capsule, cut, isosurface, mirrored, relax, smooth_step, smooth_union

WOOD, PAINT = np.array([0.58, 0.34, 0.15]), np.array([0.05, 0.28, 0.22])
SEAT, SEAT_HALF, UNDERSIDE = 0.5, 0.07, -0.035


def _box(p: np.ndarray, centre, half, rounding: float) -> np.ndarray:
    q = np.abs(p - np.asarray(centre)) - (np.asarray(half) - rounding)
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0) - rounding


def _legs(p: np.ndarray) -> np.ndarray:
    """Four legs, spread a little, a round foot on each."""
    q = np.abs(p) * [1, 0, 1] + p * [0, 1, 0]
    return capsule(q, [0.435, -0.02, 0.435], [0.49, -0.86, 0.49], 0.085, 0.055)


def _back(p: np.ndarray) -> np.ndarray:
    """Two posts and two rails, leaning backwards."""
    q = mirrored(p)
    posts = capsule(q, [0.42, 0.0, -0.43], [0.40, 0.95, -0.60], 0.075, 0.06)
    rails = np.minimum(
        capsule(q, [0.0, 0.84, -0.62], [0.40, 0.86, -0.585], 0.09),
        capsule(q, [0.0, 0.46, -0.55], [0.41, 0.48, -0.515], 0.06),
    )
    return smooth_union(posts, rails, 0.05)


def _closed(p: np.ndarray) -> np.ndarray:
    hollow = 0.03 * (1 - smooth_step(np.hypot(p[:, 0], p[:, 2]), 0.1, 0.42))
    seat = _box(p + hollow[:, None] * [0, 1, 0], [0, 0, 0], [SEAT, SEAT_HALF, SEAT], 0.05)
    return smooth_union(seat, np.minimum(_legs(p), _back(p)), 0.04)


def _kept(p: np.ndarray) -> np.ndarray:
    """Positive above the seat's lower edge, and on the legs."""
    return np.maximum(p[:, 1] - UNDERSIDE, 0.015 - _legs(p))


def _colour(p: np.ndarray) -> np.ndarray:
    """Green legs and back, a wooden seat with grain."""
    grain = 0.85 + 0.15 * np.sin(40 * p[:, 0] + 3 * np.sin(4 * p[:, 2]))
    paint = 1 - smooth_step(np.minimum(_legs(p), _back(p)), 0.005, 0.03)[:, None]
    return WOOD * grain[:, None] * (1 - paint) + PAINT * paint


def build() -> SceneObject:
    """The chair under a high sun, no view lower than six degrees above its middle."""
    whole = relax(isosurface(_closed, [-0.7, -1.0, -0.8], [0.7, 1.1, 0.7], 0.026), _closed, steps=4)
    mesh = relax(cut(whole, _kept(np.asarray(whole.vertices))), _closed, _kept, 10)
    color = _colour(np.asarray(mesh.vertices))
    return SceneObject(mesh, color, sunny_sky(50, 55), roughness=0.5, lowest_view=0.1)
