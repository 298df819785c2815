"""A toy rabbit with a ring to carry it by: closed, one handle."""

import numpy as np
import trimesh

from ..files import SceneObject
from ..lights import sunny_sky
from ..modelling import (
    capsule,
    ellipsoid,
    isosurface,
    mirrored,
    project,
    relax,
    smooth_step,
    smooth_union,
    torus,
)

FUR, PALE, PINK, DARK = (
    np.array(c) for c in ([0.42, 0.24, 0.13], [0.82, 0.74, 0.62], [0.72, 0.32, 0.30], [0.03, 0.025, 0.025])
)


def _ears(p: np.ndarray) -> np.ndarray:
    """Two flattened, slightly parted ears."""
    q = (mirrored(p) - [0.13, 0.50, 0.26]) @ _ear_frame()
    return ellipsoid(q, [0, 0.24, 0], [0.105, 0.30, 0.07])


def _ear_frame() -> np.ndarray:
    """Columns: across the ear, along it, through it."""
    along = np.array([0.30, 1.0, -0.35])
    along /= np.linalg.norm(along)
    across = np.array([1.0, 0, 0]) - along[0] * along
    across /= np.linalg.norm(across)
    return np.stack([across, along, np.cross(across, along)], 1)


def _ring(p: np.ndarray) -> np.ndarray:
    """The handle, from the neck to the rump."""
    return torus(p, [0, 0.12, -0.36], [1, 0, 0], 0.26, 0.065)


def _body(p: np.ndarray) -> np.ndarray:
    q = mirrored(p)
    d = ellipsoid(p, [0, -0.30, -0.10], [0.40, 0.40, 0.52])
    d = smooth_union(d, ellipsoid(p, [0, 0.26, 0.36], [0.27, 0.25, 0.29]), 0.16)  # head
    d = smooth_union(d, ellipsoid(p, [0, 0.18, 0.58], [0.13, 0.10, 0.12]), 0.10)  # muzzle
    d = smooth_union(d, ellipsoid(q, [0.33, -0.42, -0.24], [0.17, 0.27, 0.30]), 0.08)  # thighs
    d = smooth_union(d, capsule(q, [0.28, -0.68, -0.22], [0.27, -0.69, 0.20], 0.09), 0.06)  # hind feet
    d = smooth_union(d, capsule(q, [0.14, -0.30, 0.32], [0.15, -0.68, 0.46], 0.10, 0.08), 0.08)  # fore feet
    d = smooth_union(d, ellipsoid(p, [0, -0.28, -0.68], [0.14, 0.14, 0.13]), 0.04)  # tail
    d = smooth_union(d, _ears(p), 0.06)
    return smooth_union(d, _ring(p), 0.08)


def _colour(p: np.ndarray) -> np.ndarray:
    """Brown fur; pale belly, muzzle and tail; pink inside the ears; dark eyes and nose."""
    q = mirrored(p)
    color = np.broadcast_to(FUR, p.shape)

    def paint(color, over, distance, softness=0.02):
        return color + (1 - smooth_step(distance, -softness, softness))[:, None] * (over - color)

    color = paint(color, PALE, ellipsoid(p, [0, -0.38, 0.30], [0.24, 0.34, 0.34]), 0.04)
    color = paint(color, PALE, ellipsoid(p, [0, 0.15, 0.66], [0.16, 0.12, 0.16]), 0.03)
    color = paint(color, PALE, ellipsoid(p, [0, -0.28, -0.72], [0.16, 0.16, 0.15]))
    ear = (q - [0.13, 0.50, 0.26]) @ _ear_frame()
    color = paint(color, PINK, ellipsoid(ear, [0, 0.25, 0.075], [0.06, 0.22, 0.055]), 0.015)
    color = paint(color, DARK, np.linalg.norm(q - [0.165, 0.33, 0.60], axis=1) - 0.055, 0.012)
    return paint(color, DARK, ellipsoid(p, [0, 0.235, 0.70], [0.045, 0.035, 0.05]), 0.012)


def build() -> SceneObject:
    """The rabbit under a low sun."""
    mesh = relax(isosurface(_body, [-0.8, -1.0, -1.1], [0.8, 1.2, 1.0], 0.0235), _body, steps=4)
    mesh = trimesh.Trimesh(project(_body, np.asarray(mesh.vertices)), mesh.faces, process=False)
    return SceneObject(mesh, _colour(np.asarray(mesh.vertices)), sunny_sky(20, 40), roughness=0.6)
