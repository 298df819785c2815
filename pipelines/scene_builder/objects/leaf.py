"""A leaf: one curved sheet with a pointed outline, veins in colour and in relief."""

import numpy as np
import trimesh

from ..files import SceneObject
from ..lights import sunny_sky
from ..modelling import smooth_step

BLADE, VEIN = np.array([0.10, 0.30, 0.05]), np.array([0.55, 0.58, 0.22])


def _width(u: np.ndarray) -> np.ndarray:
    """Half the width at ``u`` in [0, 1] from the stalk's end to the tip, 0 at both."""
    return 0.46 * np.sin(np.pi * u**0.8) ** 0.9 * (1 - 0.35 * u)


def _veins(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """1 on the midrib and the side veins, falling to 0 beside them; ``v`` in [-1, 1] across."""
    side = np.abs(v)
    phase = 9 * (u - 0.16 * side) - 0.25 * np.sign(v)
    lateral = np.abs(phase - np.round(phase)) / 9 * 2
    fade = smooth_step(u, 0.04, 0.12) * (1 - smooth_step(u, 0.88, 0.96)) * (1 - smooth_step(side, 0.75, 0.95))
    rib = 1 - smooth_step(side * _width(u), 0.008, 0.024)
    return np.maximum(rib, fade * (1 - smooth_step(lateral, 0.006, 0.024)))


def sheet(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A lens-shaped triangulation: one vertex at each tip; parameters ``u``, ``v`` and the faces."""
    u = np.linspace(0, 1, rows + 2)[1:-1]
    v = np.linspace(-1, 1, columns)
    u, v = (a.ravel() for a in np.meshgrid(u, v, indexing="ij"))
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (i * columns + j).ravel()
    b, c, d = a + 1, a + columns, a + columns + 1
    # Diagonals mirror at the midrib, as the veins do.
    left = (j < columns // 2).ravel()
    quads = np.concatenate(
        [
            np.stack([a, c, d], 1)[left],
            np.stack([a, d, b], 1)[left],
            np.stack([a, c, b], 1)[~left],
            np.stack([b, c, d], 1)[~left],
        ]
    )
    j, last = np.arange(columns - 1), (rows - 1) * columns
    n = rows * columns
    tips = np.concatenate(
        [
            np.stack([np.full_like(j, n), j, j + 1], 1),
            np.stack([last + j, np.full_like(j, n + 1), last + j + 1], 1),
        ]
    )
    return np.r_[u, 0, 1], np.r_[v, 0, 0], np.concatenate([quads, tips])


def build() -> SceneObject:
    """The leaf under an afternoon sky."""
    u, v, faces = sheet(200, 81)
    x, side = _width(u) * v, np.abs(v)
    # Arched along its length, the halves folded up from the midrib, the rim waved, the tip turned down.
    z = (
        0.22 * np.sin(np.pi * (0.15 + 0.95 * u))
        + 0.45 * np.hypot(x, 0.05)
        - 0.25 * u**3
        + 0.035 * side**2 * np.sin(5.5 * np.pi * u + 0.8 * np.sign(v)) * np.sin(np.pi * u)
    )
    vein = _veins(u, v)
    z -= 0.006 * vein
    vertices = np.stack([x + 0.12 * np.sin(2.2 * u), z, 0.9 - 1.8 * u], 1)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    color = BLADE * (1 + 0.25 * np.sin(3 * u + v)[:, None]) + vein[:, None] * (VEIN - BLADE)
    return SceneObject(mesh, np.clip(color, 0, 1), sunny_sky(-60, 35, sun_share=0.5), roughness=0.5)
