"""Scores of a set of shapes against a set of true ones, each shape being points on its surface.

Achlioptas et al., "Learning Representations and Generative Models for 3D Point Clouds" (ICML 2018): minimum
matching distance, coverage and the Jensen-Shannon divergence; Yang et al., "PointFlow" (ICCV 2019): the
accuracy of a nearest neighbour as classifier.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from ..arrays import Array3f, Float, UInt32

#: Cells per side in which points are counted.
_JSD_CELLS = 28


def chamfer_distances(
    a: np.ndarray, b: np.ndarray | None = None, told: Callable[[], None] = lambda: None
) -> np.ndarray:
    """(len(a), len(b)) mean distances to the nearest point, there and back, halved. Needs a Mitsuba variant.

    Args:
        a: (n, p, 3).
        b: (m, q, 3); the same as ``a`` by default, at half the cost.
        told: called after each row.

    >>> points = np.zeros((1, 4, 3))
    >>> chamfer_distances(points, points + [0, 3, 4])
    array([[5.]])
    """
    others = a if b is None else b
    found = np.zeros((len(a), len(others)))
    for i, points in enumerate(a):
        first = i + 1 if b is None else 0
        found[i, first:] = _chamfer(points, others[first:])
        told()
    return found + found.T if b is None else found


def nearest_chamfer_distances(
    a: np.ndarray, b: np.ndarray, tried: int = 32, told: Callable[[], None] = lambda: None
) -> np.ndarray:
    """(len(a),) chamfer distances of each shape to the nearest of many. Needs a Mitsuba variant.

    Some 64 points of each choose the ``tried`` likeliest ones; among them all points decide.

    Args:
        a: (n, p, 3).
        b: (m, q, 3).
        tried: of ``b``, for each of ``a``.
        told: called after each row.

    >>> points = np.zeros((1, 8, 3))
    >>> nearest_chamfer_distances(points, np.concatenate([points + 2, points + [0, 3, 4]])).round(3)
    array([3.464])
    """
    rough = b[:, :: max(b.shape[1] // 64, 1)]
    found = np.empty(len(a))
    for i, points in enumerate(a):
        likely = np.argsort(_chamfer(points[:: max(len(points) // 64, 1)], rough), kind="stable")[:tried]
        found[i] = _chamfer(points, b[likely]).min()
        told()
    return found


def _chamfer(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(m,) chamfer distances of one shape, (p, 3), to m others, (m, q, 3). All pairs of points are compared,
    which is faster than a tree for some hundreds of points."""
    import mitsuba as mi

    many, each, count = len(others), others.shape[1], len(points)
    if not many:
        return np.zeros(0)
    shape, all_others = (
        mi.Point3f(np.ascontiguousarray(given.reshape(-1, 3).T, np.float32)) for given in (points, others)
    )
    there = _to_nearest(all_others, mi.UInt32(0), shape, count)
    lane = dr.arange(mi.UInt32, many * count)
    other = lane // dr.opaque(mi.UInt32, count)
    query = dr.gather(mi.Point3f, shape, lane - other * dr.opaque(mi.UInt32, count))
    back = _to_nearest(query, other * dr.opaque(mi.UInt32, each), all_others, each)
    return (there.numpy().reshape(many, -1).mean(axis=1) + back.numpy().reshape(many, -1).mean(axis=1)) / 2


def _to_nearest(query: Array3f, first: UInt32, cloud: Array3f, count: int) -> Float:
    """Distance of each query to the nearest of ``count`` points of a cloud, from ``first`` on."""
    import mitsuba as mi

    stop = dr.opaque(mi.UInt32, count)

    def body(index: UInt32, least: Float) -> tuple[UInt32, Float]:
        offset = dr.gather(mi.Point3f, cloud, first + index) - query
        return index + 1, dr.minimum(least, dr.squared_norm(offset))

    begin = mi.UInt32(0), dr.full(mi.Float, dr.inf, dr.width(query))
    return dr.sqrt(dr.while_loop(begin, lambda index, least: index < stop, body)[1])


def earth_movers_distances(
    a: np.ndarray, b: np.ndarray, told: Callable[[], None] = lambda: None
) -> np.ndarray:
    """(len(a), len(b)) mean distances of the best one-to-one matching of (n, p, 3) and (m, p, 3) points.

    Args:
        told: called after each row.

    >>> earth_movers_distances(np.zeros((1, 4, 3)), np.ones((1, 4, 3))).round(3)
    array([[1.732]])
    """
    found = np.empty((len(a), len(b)))
    for i, points in enumerate(a):
        for j, others in enumerate(b):
            cost = cdist(points, others)
            found[i, j] = cost[linear_sum_assignment(cost)].mean()
        told()
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
