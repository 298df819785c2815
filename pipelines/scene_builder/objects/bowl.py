"""A hammered bowl of copper and brass: wide open, a mirror to the sky and to itself."""

import numpy as np
import trimesh

from ..files import SceneObject
from ..lights import sunny_sky
from ..modelling import even_profile, revolve, smooth_step

#: Profile from the centre of the foot to the lip: radius, height.
PROFILE = np.array(
    [
        [0.00, -0.50],
        [0.20, -0.50],
        [0.30, -0.49],
        [0.46, -0.43],
        [0.66, -0.27],
        [0.79, -0.04],
        [0.85, 0.20],
        [0.90, 0.30],
    ]
)
COPPER, BRASS = np.array([0.93, 0.45, 0.30]), np.array([0.88, 0.72, 0.36])


def _hammered(p: np.ndarray) -> np.ndarray:
    """Depth of round dents, spread over the wall by the golden angle, 0 at the lip."""
    k = np.arange(220)
    height = -0.5 + 0.72 * np.sqrt((k + 0.5) / len(k))
    radius = np.interp(height, PROFILE[2:, 1], PROFILE[2:, 0])
    phi = k * np.pi * (3 - 5**0.5)
    centres = np.stack([radius * np.cos(phi), height, radius * np.sin(phi)], 1)
    nearest = np.linalg.norm(p[:, None] - centres, axis=2).min(1)
    return 0.006 * (1 - smooth_step(nearest, 0.0, 0.09)) * (1 - smooth_step(p[:, 1], 0.14, 0.22))


def build() -> SceneObject:
    """The bowl under a high sun."""
    mesh = revolve(even_profile(PROFILE, 78), 160)
    vertices = np.asarray(mesh.vertices) - _hammered(np.asarray(mesh.vertices))[:, None] * mesh.vertex_normals
    x, y, z = vertices.T
    # A brass lip and a brass star around the foot.
    star = np.hypot(x, z) - 0.42 - 0.14 * np.cos(8 * np.arctan2(z, x))
    brass = 1 - smooth_step(np.minimum(star, 0.16 - y), -0.012, 0.012)[:, None]
    mesh = trimesh.Trimesh(vertices, mesh.faces, process=False)
    color = COPPER + brass * (BRASS - COPPER)
    return SceneObject(mesh, color, sunny_sky(35, 55), roughness=0.22, metallic=1.0)
