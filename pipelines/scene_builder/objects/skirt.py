"""A circle skirt on an invisible figure: a flat ring of cloth that gravity lays into deep folds."""

import numpy as np
import trimesh
from scipy.spatial import Delaunay

from ..cloth import drape
from ..files import SceneObject
from ..lights import sunny_sky
from ..modelling import capsule, smooth_step, smooth_union

#: Radii of the ring, and the height at which it starts to fall.
WAIST, HEM, HEIGHT = 0.27, 1.12, 0.42
ROSE, NIGHT = np.array([0.66, 0.16, 0.20]), np.array([0.05, 0.06, 0.16])


def _body(p: np.ndarray, _: float) -> np.ndarray:
    """Waist, hips and legs as one column, flattened front to back."""
    flat = p * [1, 1, 1.25]
    column = capsule(flat, [0, 0.6, 0], [0, -0.1, 0], 0.20, 0.40)
    return smooth_union(column, capsule(flat, [0, -0.1, 0], [0, -1.5, 0], 0.36, 0.30), 0.1) / 1.12


def cut_pattern(cell: float) -> trimesh.Trimesh:
    """The flat ring of cloth, of nearly equilateral triangles with edges of about ``cell``."""
    points = []
    for k, radius in enumerate(np.linspace(WAIST, HEM, round((HEM - WAIST) / (0.87 * cell)) + 1)):
        n = round(2 * np.pi * radius / cell)
        phi = (np.arange(n) + k * 0.5) / n * 2 * np.pi
        points.append(radius * np.stack([np.sin(phi), np.cos(phi)], 1))
    points = np.concatenate(points)
    faces = Delaunay(points).simplices
    faces = faces[np.linalg.norm(points[faces].mean(1), axis=1) > WAIST]
    x, z = points.T
    corner = points[faces]
    (ax, az), (bx, bz) = (corner[:, 1] - corner[:, 0]).T, (corner[:, 2] - corner[:, 0]).T
    downward = az * bx - ax * bz < 0
    faces[downward] = faces[downward][:, ::-1]
    return trimesh.Trimesh(np.stack([x, np.full(len(x), HEIGHT), z], 1), faces, process=False)


def build() -> SceneObject:
    """The skirt under a low sun."""
    pattern = cut_pattern(0.042)
    rest = np.asarray(pattern.vertices)
    # A ripple, unlike on every side, so that the folds have somewhere to start.
    phi, r = np.arctan2(rest[:, 2], rest[:, 0]), np.hypot(rest[:, 0], rest[:, 2])
    ripple = 0.03 * (np.sin(9 * phi + 0.4) + 0.7 * np.sin(13 * phi + 2) + 0.5 * np.sin(4 * phi))
    start = rest + (ripple * smooth_step(r, WAIST, HEM))[:, None] * [0, 1, 0]
    draped = drape(
        trimesh.Trimesh(start, pattern.faces, process=False),
        _body,
        bending=3e-5,
        thickness=0.05,
        friction=0.4,
    )
    # The same subdivision of both shapes gives the same vertices in the same order.
    skirt = trimesh.Trimesh(draped, pattern.faces, process=False).subdivide_loop(1)
    cloth = np.asarray(pattern.subdivide_loop(1).vertices)
    r = np.hypot(cloth[:, 0], cloth[:, 2])
    bands = np.minimum.reduce([np.abs(r - 1.02) - 0.035, np.abs(r - 0.90) - 0.02, np.abs(r - WAIST) - 0.07])
    dots = np.hypot(*(np.abs((cloth[:, [0, 2]] / 0.16) % 1 - 0.5) * 0.16).T) - 0.035
    ink = 1 - smooth_step(np.minimum(bands, np.maximum(dots, r - 0.84)), -0.012, 0.012)[:, None]
    return SceneObject(skirt, ROSE + ink * (NIGHT - ROSE), sunny_sky(15, 38), roughness=0.8)
