"""Distance to what depth maps of posed views leave: everything that no view looks through."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..views import PinholeViews


def fused_distance(points: mi.Point3f, views: PinholeViews, depths: list[np.ndarray], *, truncation: float,
                   votes: int) -> mi.Float:
    """Signed distance to what is not empty at ``points``, negative inside.

    Each view says how far a point lies before (positive) or behind (negative) what the view sees along the
    ray to it; before it, space is empty. A point is as empty as ``votes`` views agree it is. Unlike a mean of
    signed distances (Curless and Levoy, SIGGRAPH 1996), this keeps sheets that are seen from both sides: at
    a sheet it is 0, and positive on both sides.

    Args:
        points: positions in world units.
        views: the cameras.
        depths: per view, (height, width) distance along the rays through the pixels' centres in world units;
            infinite where a view sees nothing, NaN where it is not known what it sees.
        truncation: largest size of a distance, world units. Neighbouring pixels whose depths differ by more
            belong to different surfaces; the nearer one counts for both.
        votes: views that have to agree.

    Returns:
        One distance per point, world units. Where fewer views say anything it is ``-truncation``.
    """
    limit = dr.opaque(mi.Float, truncation)
    greatest = [-limit * dr.full(mi.Float, 1, dr.width(points)) for _ in range(votes)]
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
        near = [dr.gather(mi.Float, stored, corner + down * stride + right, framed)
                for down in (0, 1) for right in (0, 1)]
        least, most = near[0], near[0]
        for value in near[1:]:
            least, most = dr.minimum(least, value), dr.maximum(most, value)
        between = ((1 - part[1]) * ((1 - part[0]) * near[0] + part[0] * near[1])
                   + part[1] * ((1 - part[0]) * near[2] + part[0] * near[3]))
        seen = dr.select(most - least < limit, between, least)
        distance = dr.norm(points - mi.Point3f(views.origins[index]))
        vote = dr.select(framed & (least >= 0), dr.clip(seen - distance, -limit, limit), -limit)
        for rank in range(votes):
            greatest[rank], vote = dr.maximum(greatest[rank], vote), dr.minimum(greatest[rank], vote)
        dr.eval(greatest)
    return greatest[-1]
