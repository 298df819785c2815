"""Sub-pixel visual hull: the signed distance field that the masks of posed views carve."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from ..views import PinholeViews
from .mask_outline import mask_distance, sharp


def visual_hull(
    points: mi.Point3f,
    views: PinholeViews,
    alphas: list[np.ndarray],
    *,
    daylight_votes: float = 0.06,
    progress: Callable[[], object] | None = None,
) -> mi.Float:
    """Signed distance to the visual hull at ``points``, negative inside.

    Each view bounds the object by the cone over its mask; the hull is their intersection, the
    largest of the cones' distances. Holes that a mask encloses (daylight) carve only points that
    several views agree on: one glimpse through neck and sleeve is ignored, the hole of a handle,
    which a whole fan of views looks through, is carved.

    Args:
        points: positions in world units.
        views: the cameras.
        alphas: per view, (height, width) coverage.
        daylight_votes: fraction of the views that have to see daylight at a point (at least 2 do).
        progress: called without arguments after each view.

    Returns:
        One distance per point, world units. A view whose mask keeps clear of the frame's border shows the
        whole object, so it also carves what it does not frame; points that no view says anything of are
        outside (+inf).
    """
    return doubting_hulls(points, views, alphas, [0], daylight_votes=daylight_votes, progress=progress)[0]


def doubting_hulls(
    points: mi.Point3f,
    views: PinholeViews,
    alphas: list[np.ndarray],
    disbelieved: Sequence[int],
    *,
    daylight_votes: float = 0.06,
    progress: Callable[[], object] | None = None,
) -> list[mi.Float]:
    """Signed distances to hulls that do not believe so many masks: at each point those that it is farthest
    outside of.

    Args:
        points, views, alphas, daylight_votes, progress: as of ``visual_hull``, which believes all.
        disbelieved: numbers of masks, one for each hull.
    """
    thin_parts = sharp(alphas)
    votes = max(2, round(daylight_votes * len(views)))
    # The largest distances to the filled masks, and to the unfilled ones, sorted: the last one has as many
    # supporters as there are.
    carved, daylight = (
        [dr.full(mi.Float, -dr.inf, dr.width(points)) for _ in range(count)]
        for count in (1 + max(disbelieved), votes)
    )
    for index, alpha in enumerate(alphas):
        whole = not _touches_border(alpha)
        outline = mask_distance(alpha, thin_parts=thin_parts)
        filled = plain = _cone_distance(points, views, index, outline, whole)
        if _has_holes(alpha):
            outline = mask_distance(alpha, fill_holes=False, thin_parts=thin_parts)
            plain = _cone_distance(points, views, index, outline, whole)
        for largest, value in ((carved, filled), (daylight, plain)):
            for rank, other in enumerate(largest):
                largest[rank], value = dr.maximum(other, value), dr.minimum(other, value)
        dr.eval(carved, daylight)
        if progress:
            progress()
    distances = [dr.maximum(carved[number], daylight[-1]) for number in disbelieved]
    return [dr.select(distance == -dr.inf, dr.inf, distance) for distance in distances]


def _has_holes(alpha: np.ndarray) -> bool:
    inside = alpha >= 0.5
    return bool((ndimage.binary_fill_holes(inside) & ~inside).any())


def _touches_border(alpha: np.ndarray) -> bool:
    return bool(max(alpha[[0, -1]].max(), alpha[:, [0, -1]].max()) >= 0.5)


def _cone_distance(
    points: mi.Point3f, views: PinholeViews, index: int, outline: np.ndarray, whole: bool
) -> mi.Float:
    """Distance to the cone over a mask, to first order.

    Where the view does not frame a point it is -inf, unless the view shows the ``whole`` object: then
    it is that at the frame's border, and behind the camera that to the cone's apex.
    """
    height, width = outline.shape
    film, depth = views.project(index, points)
    # A finite stand-in keeps the interpolation next to an empty mask free of NaN.
    diagonal = float(np.hypot(width, height))
    texture = mi.Texture2f(
        mi.TensorXf(np.clip(outline, -diagonal, diagonal)[..., None].astype(np.float32)),
        wrap_mode=dr.WrapMode.Clamp,
    )
    pixel = float(np.linalg.norm(views.bases[index][:, 0]) / width)
    distance = texture.eval(film)[0] * depth * pixel
    if whole:
        return dr.select(depth > 0, distance, dr.norm(points - mi.Point3f(views.origins[index])))
    framed = (depth > 0) & (film.x >= 0) & (film.x <= 1) & (film.y >= 0) & (film.y <= 1)
    return dr.select(framed, distance, -dr.inf)
