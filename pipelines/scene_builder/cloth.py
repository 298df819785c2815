"""Draping: extended position-based dynamics of a sheet over a moving body.

Macklin et al., "XPBD: Position-Based Simulation of Compliant Constrained Dynamics" (MIG 2016), with
one iteration per small step ("Small Steps in Physics Simulation", SCA 2019). Constraints are distances:
along edges (stretch, shear) and across the two triangles of an edge (bending).
"""

from collections.abc import Callable

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from .modelling import gradient


def _colour(pairs: np.ndarray, n: int) -> list[np.ndarray]:
    """Splits pairs into groups that share no vertex, so that each group is solved at once."""
    used: list[set[int]] = [set() for _ in range(n)]
    groups: list[list[int]] = []
    for k, (i, j) in enumerate(pairs):
        c = 0
        while c in used[i] or c in used[j]:
            c += 1
        used[i].add(c)
        used[j].add(c)
        if c == len(groups):
            groups.append([])
        groups[c].append(k)
    return [np.array(g) for g in groups]


def drape(
    mesh: trimesh.Trimesh,
    body: Callable[[np.ndarray, float], np.ndarray],
    *,
    seconds: float = 3.0,
    steps_per_second: int = 600,
    gravity: float = 6.0,
    bending: float = 2e-5,
    thickness: float = 0.03,
    friction: float = 0.3,
    damping: float = 1.5,
    ease: float = 1.0,
) -> np.ndarray:
    """Vertex positions ``(n, 3)`` of the sheet at rest on the body.

    ``body(points, t)`` is a distance function for t in [0, 1], the share of the run's time; ``bending``
    is the compliance of the bending constraints, ``thickness`` the distance that parts of the sheet
    keep from one another, ``ease`` scales the rest lengths: more than 1 is loose cloth.
    """
    x = np.asarray(mesh.vertices).copy()
    n = len(x)
    stretch = np.asarray(mesh.edges_unique)
    unshared = np.asarray(mesh.face_adjacency_unshared)
    groups = []
    for pairs, compliance, scale in ((stretch, 1e-8, ease), (unshared, bending, ease)):
        rest = scale * np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
        groups += [(*pairs[g].T, rest[g], compliance) for g in _colour(pairs, n)]

    rest_positions, dt = x.copy(), 1 / steps_per_second
    v = np.zeros_like(x)
    total = int(seconds * steps_per_second)
    near = np.zeros((0, 2), int)
    for step in range(total):
        v[:, 1] -= gravity * dt
        v *= 1 - damping * dt
        old = x.copy()
        x = x + dt * v
        for i, j, rest, compliance in groups:
            d = x[i] - x[j]
            length = np.linalg.norm(d, axis=1)
            push = ((rest - length) / ((2 + compliance / dt**2) * np.maximum(length, 1e-9)))[:, None] * d
            x[i] += push
            x[j] -= push
        if step % 10 == 0:
            near = cKDTree(x).query_pairs(1.5 * thickness, output_type="ndarray")
            near = near[
                np.linalg.norm(rest_positions[near[:, 0]] - rest_positions[near[:, 1]], axis=1)
                > 2.5 * thickness
            ]
        if len(near):
            i, j = near.T
            d = x[i] - x[j]
            length = np.linalg.norm(d, axis=1)
            push = (np.clip(thickness - length, 0, None) / (4 * np.maximum(length, 1e-9)))[:, None] * d
            np.add.at(x, i, push)
            np.add.at(x, j, -push)
        t = step / total
        s = body(x, t)
        touching = np.flatnonzero(s < 0.5 * thickness)
        if len(touching):
            p = x[touching]
            g = gradient(lambda q, t=t: body(q, t), p, 1e-3)
            g /= np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-9)
            p = p + (0.5 * thickness - s[touching])[:, None] * g
            slide = p - old[touching]
            slide -= (slide * g).sum(1, keepdims=True) * g
            x[touching] = p - friction * slide
        v = (x - old) / dt
    return x
