"""Scores of a set of shapes against a set of true ones, each shape being points on its surface.

Achlioptas et al., "Learning Representations and Generative Models for 3D Point Clouds" (ICML 2018): minimum
matching distance, coverage and the Jensen-Shannon divergence; Yang et al., "PointFlow" (ICCV 2019): the
accuracy of a nearest neighbour as classifier.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

Points = np.ndarray | Sequence[np.ndarray]

#: Cells per side in which points are counted.
_JSD_CELLS = 28


def chamfer_distances(
    a: Points, b: Points | None = None, told: Callable[[], None] = lambda: None
) -> np.ndarray:
    """(len(a), len(b)) mean distances to the nearest point, there and back, halved.

    Args:
        a: (n, p, 3), or n sets of points, (p, 3) each.
        b: (m, q, 3); the same as ``a`` by default, at half the cost.
        told: called after each row.

    >>> points = np.zeros((1, 4, 3))
    >>> chamfer_distances(points, points + [0, 3, 4])
    array([[5.]])
    """
    trees = [cKDTree(points) for points in a]
    others = trees if b is None else [cKDTree(points) for points in b]
    found = np.zeros((len(trees), len(others)))
    for i, tree in enumerate(trees):
        for j in range(i + 1 if b is None else 0, len(others)):
            found[i, j] = _chamfer(tree, others[j])
        told()
    return found + found.T if b is None else found


def nearest_chamfer_distances(
    a: np.ndarray, b: np.ndarray, tried: int = 32, told: Callable[[], None] = lambda: None
) -> np.ndarray:
    """(len(a),) chamfer distances of each shape to the nearest of many.

    Some 64 points of each choose the ``tried`` likeliest ones; among them all points decide.

    Args:
        a: (n, p, 3).
        b: (m, q, 3).
        tried: of ``b``, for each of ``a``.
        told: called after each row.

    >>> points = np.zeros((1, 8, 3))
    >>> nearest_chamfer_distances(points, np.concatenate([points + 2, points + [0, 3, 4]]))
    array([3.46410162])
    """
    rough = [cKDTree(points) for points in b[:, :: max(len(b[0]) // 64, 1)]]
    trees: dict[int, cKDTree] = {}
    found = np.empty(len(a))
    for i, points in enumerate(a):
        coarse, tree = cKDTree(points[:: max(len(points) // 64, 1)]), cKDTree(points)
        likely = np.argsort([_chamfer(coarse, other) for other in rough], kind="stable")[:tried]
        for j in likely:
            trees.setdefault(j, cKDTree(b[j]))
        found[i] = min(_chamfer(tree, trees[j]) for j in likely)
        told()
    return found


def _chamfer(a: cKDTree, b: cKDTree) -> float:
    return (a.query(b.data)[0].mean() + b.query(a.data)[0].mean()) / 2


def earth_movers_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(len(a), len(b)) mean distances of the best one-to-one matching of (n, p, 3) and (m, p, 3) points.

    >>> earth_movers_distances(np.zeros((1, 4, 3)), np.ones((1, 4, 3))).round(3)
    array([[1.732]])
    """
    found = np.empty((len(a), len(b)))
    for i, points in enumerate(a):
        for j, others in enumerate(b):
            cost = cdist(points, others)
            found[i, j] = cost[linear_sum_assignment(cost)].mean()
    return found


def minimum_matching_distance(between: np.ndarray) -> float:
    """Mean, over the true shapes, of the distance to the nearest sample.

    Args:
        between: (samples, true shapes) distances.
    """
    return float(between.min(axis=0).mean())


def coverage(between: np.ndarray) -> float:
    """Fraction of the true shapes that are nearest to some sample.

    Args:
        between: (samples, true shapes) distances.
    """
    return len(np.unique(between.argmin(axis=1))) / between.shape[1]


def nearest_neighbour_accuracy(among_a: np.ndarray, between: np.ndarray, among_b: np.ndarray) -> float:
    """How often the nearest other shape is of the same set: 0.5 where nothing tells the sets apart.

    Copies of a shape, at distance 0, are left out like itself, and of several that are equally near each
    counts its share: so identical sets have exactly 0.5.

    Args:
        among_a: (n, n) distances in the one set.
        between: (n, m).
        among_b: (m, m).

    >>> one = np.ones((3, 3))
    >>> nearest_neighbour_accuracy(one, one + 1, one), round(nearest_neighbour_accuracy(one, one, one), 3)
    (1.0, 0.4)
    """
    distance = np.block([[among_a, between], [between.T, among_b]]).astype(float)
    np.fill_diagonal(distance, np.inf)
    distance[distance == 0] = np.inf
    first = np.arange(len(distance)) < len(among_a)
    nearest = distance <= distance.min(axis=1, keepdims=True) * (1 + 1e-9)  # sums in another order
    same = first[:, None] == first
    return float(((nearest & same).sum(axis=1) / nearest.sum(axis=1)).mean())


def jensen_shannon_divergence(a: np.ndarray, b: np.ndarray) -> float:
    """Between where the points of the sets lie in [-1, 1]^3, in bits: 0 the same, 1 nowhere both.

    >>> points = np.linspace(-1, 0, 30).reshape(1, 10, 3)
    >>> jensen_shannon_divergence(points, points), jensen_shannon_divergence(points, points + 1)
    (0.0, 1.0)
    """

    def shares(points: np.ndarray) -> np.ndarray:
        cell = np.clip((points.reshape(-1, 3) + 1) / 2 * _JSD_CELLS, 0, _JSD_CELLS - 1).astype(int)
        number = cell @ np.array([1, _JSD_CELLS, _JSD_CELLS**2])
        return np.bincount(number, minlength=_JSD_CELLS**3) / len(number)

    p, q = shares(a), shares(b)
    mean = (p + q) / 2

    def divergence(of: np.ndarray) -> float:
        there = of > 0
        return float((of[there] * np.log2(of[there] / mean[there])).sum())

    return round((divergence(p) + divergence(q)) / 2, 12)
