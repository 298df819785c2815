"""Sub-pixel visual hull: the signed distance field that the masks of posed views carve."""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from .mask_distances import MaskDistances


def visual_hull(
    points: mi.Point3f, masks: MaskDistances, *, daylight_votes: float = 0.06, reach: float = math.inf
) -> mi.Float:
    """Signed distance to the visual hull at ``points``, negative inside.

    Each view bounds the object by the cone over its mask; the hull is their intersection, the
    largest of the cones' distances. Holes that a mask encloses (daylight) carve only points that
    several views agree on: one glimpse through neck and sleeve is ignored, the hole of a handle,
    which a whole fan of views looks through, is carved.

    Args:
        points: positions in world units.
        masks: of the views.
        daylight_votes: fraction of the views that have to see daylight at a point (at least 2 do).
        reach: the largest distance that is told, world units. Points farther outside take less time.

    Returns:
        One distance per point, world units. A view whose mask keeps clear of the frame's border shows the
        whole object, so it also carves what it does not frame; points that no view says anything of are
        outside (``reach``).
    """
    return doubting_hulls(points, masks, [0], daylight_votes=daylight_votes, reach=reach)[0]


def doubting_hulls(
    points: mi.Point3f,
    masks: MaskDistances,
    disbelieved: Sequence[int],
    *,
    daylight_votes: float = 0.06,
    reach: float = math.inf,
) -> list[mi.Float]:
    """Signed distances to hulls that do not believe so many masks: at each point those that it is farthest
    outside of.

    Args:
        points, masks, daylight_votes, reach: as of ``visual_hull``, which believes all.
        disbelieved: numbers of masks, one for each hull.
    """
    carved = _largest(points, masks, masks.filled, 1 + max(disbelieved), reach)
    distances = [carved[number] for number in disbelieved]
    if masks.plain is not masks.filled:
        near = dr.compress(carved[-1] < reach)
        votes = max(2, round(daylight_votes * len(masks.views)))
        # The last one has as many supporters as there are votes.
        daylight = dr.full(mi.Float, -dr.inf, dr.width(points))
        if dr.width(near):
            some = dr.gather(mi.Point3f, mi.Point3f(points), near)
            dr.scatter(daylight, _largest(some, masks, masks.plain, votes, reach)[-1], near)
        distances = [dr.maximum(distance, daylight) for distance in distances]
    return [dr.minimum(dr.select(distance == -dr.inf, reach, distance), reach) for distance in distances]


def _largest(
    points: mi.Point3f, masks: MaskDistances, distances: mi.Float, count: int, reach: float
) -> list[mi.Float]:
    """The largest distances of each point to the cones of all views, from the first to the ``count``-th; of
    some views, where all of these are beyond reach."""

    def body(view: mi.UInt32, *largest: mi.Float) -> tuple[mi.UInt32, ...]:
        value, ranked = masks.cone_distance(distances, view, points), []
        for other in largest:
            ranked.append(dr.maximum(other, value))
            value = dr.minimum(other, value)
        return view + 1, *ranked

    number, farthest = dr.opaque(mi.UInt32, len(masks.views)), dr.opaque(mi.Float, reach)
    begin = dr.zeros(mi.UInt32, dr.width(points)), *(mi.Float(-dr.inf) for _ in range(count))
    _, *largest = dr.while_loop(
        begin, lambda view, *largest: (view < number) & (largest[-1] < farthest), body
    )
    dr.eval(largest)
    return largest
