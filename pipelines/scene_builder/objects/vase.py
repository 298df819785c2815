"""A glazed vase: a surface of revolution with one opening and a painted band, deep inside."""

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

from ..files import SceneObject
from ..lights import studio
from ..modelling import smooth_step

#: Profile from the centre of the foot to the lip: height against radius.
PROFILE = np.array([
    [0.00, -0.905], [0.13, -0.905], [0.24, -0.90], [0.275, -0.875], [0.265, -0.83],
    [0.30, -0.74], [0.43, -0.52], [0.53, -0.25], [0.545, 0.00], [0.45, 0.26],
    [0.28, 0.48], [0.205, 0.62], [0.20, 0.72], [0.26, 0.84], [0.34, 0.90],
])
GLAZE, PAINT = np.array([0.62, 0.11, 0.07]), np.array([0.86, 0.78, 0.62])


def _profile(n: int) -> np.ndarray:
    """``n`` points ``(radius, height)`` evenly spaced along the curve."""
    along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(PROFILE, axis=0), axis=1))]
    dense = PchipInterpolator(along, PROFILE)(np.linspace(0, along[-1], 4000))
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))]
    at = np.linspace(0, length[-1], n)
    return np.stack([np.interp(at, length, dense[:, i]) for i in range(2)], 1)


def revolve(profile: np.ndarray, sides: int) -> trimesh.Trimesh:
    """Turns a profile that starts on the axis about y; one pole, one open rim, faces outwards."""
    n = len(profile) - 1
    phi = np.arange(sides) / sides * 2 * np.pi
    r, y = profile[1:, :1], profile[1:, 1:]
    ring = np.stack([r * np.cos(phi), np.broadcast_to(y, (n, sides)), r * np.sin(phi)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    quads = np.stack([a, a + sides, b + sides, a, b + sides, b], -1).reshape(-1, 3)
    j = np.arange(sides)
    pole = np.stack([np.full(sides, n * sides), j, (j + 1) % sides], 1)
    vertices = np.concatenate([ring, [[0, profile[0, 1], 0]]])
    return trimesh.Trimesh(vertices, np.concatenate([quads, pole]), process=False)


def build() -> SceneObject:
    """The vase between two soft boxes."""
    mesh = revolve(_profile(108), 160)
    x, y, z = np.asarray(mesh.vertices).T
    phi = np.arctan2(z, x)
    # Two rings, and between them a wave that meets itself after six turns.
    ring = np.minimum(abs(y - 0.20), abs(y + 0.32)) - 0.022
    wave = abs(y + 0.06 - 0.13 * np.sin(6 * phi)) - 0.045
    paint = 1 - smooth_step(np.minimum(ring, wave), -0.013, 0.013)[:, None]
    boxes = [(40, 35, 12, [3.2, 3.1, 2.9]), (-70, 20, 16, [1.4, 1.6, 2.0]), (170, 60, 14, [1.5, 1.4, 1.2])]
    return SceneObject(mesh, GLAZE + paint * (PAINT - GLAZE), studio(boxes), roughness=0.2)
