"""A curved sheet with irregular holes, and loose islands of the same sheet in three of them."""

import numpy as np
import trimesh

from ..files import SceneObject
from ..lights import sunny_sky
from ..modelling import cut, relax, smooth_step

#: Across and along the sheet: centre, mean radius and phase of the wobbling outline of each hole.
HOLES = np.array(
    [
        [-0.56, -0.52, 0.15, 0.3],
        [-0.10, -0.58, 0.12, 1.9],
        [0.42, -0.50, 0.22, 4.0],
        [-0.60, 0.02, 0.20, 2.6],
        [-0.14, -0.14, 0.16, 5.2],
        [0.22, 0.06, 0.10, 0.8],
        [0.62, 0.04, 0.16, 3.3],
        [-0.54, 0.52, 0.13, 1.2],
        [-0.08, 0.44, 0.24, 5.9],
        [0.36, 0.42, 0.09, 2.2],
        [0.62, 0.56, 0.14, 4.6],
    ]
)
#: The same for the islands.
ISLANDS = np.array([[0.42, -0.50, 0.10, 1.0], [-0.60, 0.02, 0.085, 4.4], [-0.08, 0.44, 0.12, 2.9]])
INDIGO, OCHRE = np.array([0.06, 0.09, 0.32]), np.array([0.78, 0.52, 0.16])


def _blobs(p: np.ndarray, blobs: np.ndarray) -> np.ndarray:
    """Distance to the nearest blob in the plane of the pattern, negative inside."""
    d = p[:, None, [0, 2]] - blobs[:, :2]
    angle, phase = np.arctan2(d[..., 1], d[..., 0]), blobs[:, 3]
    wobble = 1 + 0.16 * np.sin(2 * angle + phase) + 0.12 * np.sin(3 * angle - 2 * phase)
    return (np.linalg.norm(d, axis=2) - blobs[:, 2] * wobble).min(1)


def _pattern(p: np.ndarray) -> np.ndarray:
    """Positive on the sheet: inside its outline, outside the holes, or on an island."""
    outline = 0.88 - ((p[:, 0] / 1.0) ** 4 + (p[:, 2] / 0.98) ** 4) ** 0.25
    return np.maximum(np.minimum(outline, _blobs(p, HOLES)), -_blobs(p, ISLANDS))


def _height(p: np.ndarray) -> np.ndarray:
    """Distance above the sheet: one wave across it, a gentle arch along it."""
    x, y, z = p.T
    return y - (0.26 * np.sin(2.4 * x) + 0.16 * np.cos(1.9 * z + 0.6 * x))


def build() -> SceneObject:
    """The sheet under an afternoon sun."""
    n = 96
    x, z = np.meshgrid(*2 * [np.linspace(-0.93, 0.93, n)], indexing="ij")
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (j.ravel() for j in (i[:-1, :-1], i[1:, :-1], i[:-1, 1:], i[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    flat = np.stack([x.ravel(), np.zeros(n * n), z.ravel()], 1)
    flat[:, 1] = -_height(flat)
    whole = trimesh.Trimesh(flat, faces, process=False)
    mesh = relax(cut(whole, _pattern(flat), islands=True), _height, _pattern, 20)
    p = np.asarray(mesh.vertices)
    # Ochre rims around the holes, islands and outline, and ochre threads between them.
    thread = np.abs((6 * (p[:, 0] + 0.4 * p[:, 2])) % 1 - 0.5) / 6
    ochre = 1 - smooth_step(np.minimum(_pattern(p) - 0.03, thread - 0.012), -0.006, 0.006)[:, None]
    return SceneObject(mesh, INDIGO + ochre * (OCHRE - INDIGO), sunny_sky(-50, 45), roughness=0.6)
