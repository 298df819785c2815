"""A stoneware mug with a handle: closed, as its wall has a thickness, and hollow."""

import numpy as np

from ..files import SceneObject
from ..lights import studio
from ..modelling import isosurface, relax, smooth_step, smooth_union, torus

#: Of the body: radius, half height, how much narrower its ends are, thickness of wall and floor, how round
#: its edges are.
RADIUS, HALF, BELLY, WALL, FLOOR, ROUND = 0.65, 0.7, 0.06, 0.13, 0.15, 0.06
GLAZE, CLAY = np.array([0.10, 0.30, 0.36]), np.array([0.68, 0.58, 0.45])


def _both(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Intersection with a round edge."""
    return -smooth_union(-a, -b, ROUND)


def _mug(p: np.ndarray) -> np.ndarray:
    y = p[:, 1]
    radius = np.hypot(p[:, 0], p[:, 2]) + BELLY * (y / HALF) ** 2
    hollow = _both(radius - (RADIUS - WALL), FLOOR - HALF - y)
    handle = np.maximum(torus(p, [RADIUS, 0, 0], [0, 0, 1], 0.38, 0.09), RADIUS - 0.5 * WALL - radius)
    body = smooth_union(_both(radius - RADIUS, np.abs(y) - HALF), handle, 0.06)
    return _both(body, -hollow)


def _colour(p: np.ndarray) -> np.ndarray:
    """Speckled clay, dipped into a glaze whose edge runs down in waves."""
    x, y, z = p.T
    phi = np.arctan2(z, x)
    speckles = sum(np.sin(p @ k) for k in 9.0 * np.random.default_rng(3).normal(size=(12, 3)))
    clay = CLAY * (1 - 0.35 * smooth_step(speckles, 1, 3))[:, None]
    glaze = GLAZE * (1 + 0.6 * smooth_step(speckles, -1, 1))[:, None]
    glazed = smooth_step(y + 0.1 + 0.07 * np.sin(5 * phi) + 0.04 * np.sin(13 * phi), -0.02, 0.02)[:, None]
    return clay + glazed * (glaze - clay)


def build() -> SceneObject:
    """The mug between three soft boxes."""
    mesh = relax(isosurface(_mug, [-0.7, -0.8, -0.7], [1.2, 0.8, 0.7], 0.029), _mug, steps=10)
    boxes = [(40, 35, 14, [3.0, 3.0, 2.8]), (-90, 30, 16, [1.5, 1.6, 2.0]), (170, 50, 16, [1.5, 1.4, 1.2])]
    return SceneObject(mesh, _colour(np.asarray(mesh.vertices)), studio(boxes), roughness=0.4)
