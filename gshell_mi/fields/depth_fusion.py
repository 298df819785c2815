"""Distance to what depth maps of posed views leave: what too few of the views look through."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..views import PinholeViews

#: Levels between the truncations at which the views' distances are told apart.
_LEVELS = 24


def fused_distance(
    points: mi.Point3f, views: PinholeViews, depths: list[np.ndarray], *, truncation: float, share: float
) -> mi.Float:
    """Signed distance to what is not empty at ``points``, negative inside.

    Each view says how far a point lies before (positive) or behind (negative) what the view sees along the
    ray to it; before it, space is empty. Of the views that something nearer does not hide the point from, a
    ``share`` has to say that it is empty. Unlike a mean of signed distances (Curless and Levoy, SIGGRAPH
    1996) this keeps sheets that are seen from both sides: at a sheet it is 0, and positive on both sides.

    Args:
        points: positions in world units.
        views: the cameras.
        depths: per view, (height, width) distance along the rays through the pixels' centres in world units;
            infinite where a view sees nothing, NaN where it is not known what it sees.
        truncation: largest size of a distance, world units. Neighbouring pixels whose depths differ by more
            belong to different surfaces; the nearer one counts for both.
        share: of the views that have to agree, in (0, 1).

    Returns:
        One distance per point, world units. Where no view says anything it is ``-truncation``.
    """
    limit, count = dr.opaque(mi.Float, truncation), dr.width(points)
    # Per point and level between the truncations: how many views say so, and the sum of what they say.
    numbers, sums = (dr.zeros(mi.Float, count * _LEVELS) for _ in range(2))
    lane = dr.arange(mi.UInt32, count) * _LEVELS
    for index, depth in enumerate(depths):
        height, width = depth.shape
        film, along = views.project(index, points)
        size = dr.opaque(mi.Float, width), dr.opaque(mi.Float, height)
        x, y = film.x * size[0] - 0.5, film.y * size[1] - 0.5
        framed = (along > 0) & (x >= 0) & (y >= 0) & (x < size[0] - 1) & (y < size[1] - 1)
        column, row = mi.Int32(dr.floor(x)), mi.Int32(dr.floor(y))
        part = x - mi.Float(column), y - mi.Float(row)
        stored = mi.Float(np.where(np.isnan(depth), -1, np.minimum(depth, 1e6)).astype(np.float32).ravel())
        stride = dr.opaque(mi.Int32, width)
        corner = row * stride + column
        near = [
            dr.gather(mi.Float, stored, corner + down * stride + right, framed)
            for down in (0, 1)
            for right in (0, 1)
        ]
        least, most = near[0], near[0]
        for value in near[1:]:
            least, most = dr.minimum(least, value), dr.maximum(most, value)
        between = (1 - part[1]) * ((1 - part[0]) * near[0] + part[0] * near[1]) + part[1] * (
            (1 - part[0]) * near[2] + part[0] * near[3]
        )
        seen = dr.select(most - least < limit, between, least)
        vote = (seen - dr.norm(points - mi.Point3f(views.origins[index]))) / limit
        told = framed & (least >= 0) & (vote > -1)
        vote = dr.minimum(vote, 1)
        level = mi.UInt32(dr.minimum((vote + 1) * (0.5 * _LEVELS), _LEVELS - 1))
        dr.scatter_reduce(dr.ReduceOp.Add, numbers, mi.Float(1), lane + level, told)
        dr.scatter_reduce(dr.ReduceOp.Add, sums, vote, lane + level, told)
        dr.eval(numbers, sums)
    here = [dr.gather(mi.Float, numbers, lane + level) for level in range(_LEVELS)]
    total = sum(here, mi.Float(0))
    above, found, sought = mi.Float(0), dr.full(mi.Float, -1, count), total > 0
    for level in reversed(range(_LEVELS)):
        above += here[level]
        reached = sought & (above >= share * total) & (here[level] > 0)
        mean = dr.gather(mi.Float, sums, lane + level) / dr.maximum(here[level], 1)
        found, sought = dr.select(reached, mean, found), sought & ~reached
    return limit * found
