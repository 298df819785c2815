"""A glazed vase: a surface of revolution with one opening and a painted band, deep inside."""

import numpy as np

from ..files import SceneObject
from ..lights import studio
from ..modelling import even_profile, revolve, smooth_step

#: Profile from the centre of the foot to the lip: radius, height.
PROFILE = np.array(
    [
        [0.00, -0.905],
        [0.13, -0.905],
        [0.24, -0.90],
        [0.275, -0.875],
        [0.265, -0.83],
        [0.30, -0.74],
        [0.43, -0.52],
        [0.53, -0.25],
        [0.545, 0.00],
        [0.45, 0.26],
        [0.28, 0.48],
        [0.205, 0.62],
        [0.20, 0.72],
        [0.26, 0.84],
        [0.34, 0.90],
    ]
)
GLAZE, PAINT = np.array([0.62, 0.11, 0.07]), np.array([0.86, 0.78, 0.62])


def build() -> SceneObject:
    """The vase between two soft boxes."""
    mesh = revolve(even_profile(PROFILE, 108), 160)
    x, y, z = np.asarray(mesh.vertices).T
    phi = np.arctan2(z, x)
    # Two rings, and between them a wave that meets itself after six turns.
    ring = np.minimum(abs(y - 0.20), abs(y + 0.32)) - 0.022
    wave = abs(y + 0.06 - 0.13 * np.sin(6 * phi)) - 0.045
    paint = 1 - smooth_step(np.minimum(ring, wave), -0.013, 0.013)[:, None]
    boxes = [(40, 35, 12, [3.2, 3.1, 2.9]), (-70, 20, 16, [1.4, 1.6, 2.0]), (170, 60, 14, [1.5, 1.4, 1.2])]
    return SceneObject(mesh, GLAZE + paint * (PAINT - GLAZE), studio(boxes), roughness=0.2)
