"""Sub-pixel visual hull: the signed distance field that the masks of posed views carve."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.measure import find_contours

from ..views import PinholeViews

#: Samples per contour segment: the nearest sample is at most 1/8 pixel from the nearest point.
_CONTOUR_SAMPLES = 4
#: Pixels nearer to the outline than this get their distance from the sub-pixel contour.
_NEAR = 6.0


def mask_distance(alpha: np.ndarray, *, fill_holes: bool = True) -> np.ndarray:
    """Signed distance to the outline of a coverage mask, negative inside.

    The outline is the level set 1/2 of the coverage, located by linear interpolation between pixel
    centres, so it is accurate to a small fraction of a pixel.

    Args:
        alpha: (height, width) coverage in [0, 1].
        fill_holes: drops outlines that are enclosed by the object. Daylight seen through a garment
            (in at the neck, out at a sleeve) would carve a tunnel through the hull whose walls then
            have to be undone.

    Returns:
        (height, width) distances at the pixel centres, in pixels. An empty mask is +inf everywhere.
    """
    inside = alpha >= 0.5
    if fill_holes:
        filled = ndimage.binary_fill_holes(inside)
        alpha = np.where(filled & ~inside, 1.0, alpha)
        inside = filled
    if not inside.any():
        return np.full(alpha.shape, np.inf)
    # The frame's border is no outline: what it cuts off may go on outside.
    contours = find_contours(alpha, 0.5)
    if not contours:
        return np.full(alpha.shape, -np.inf)
    steps = np.linspace(0.0, 1.0, _CONTOUR_SAMPLES, endpoint=False)[:, None, None]
    samples = np.concatenate([((1 - steps) * contour[:-1] + steps * contour[1:]).reshape(-1, 2)
                              for contour in contours])
    # Far from the outline the distance between pixel centres is accurate enough and much cheaper.
    distance = ndimage.distance_transform_edt(inside) + ndimage.distance_transform_edt(~inside) - 0.5
    near = distance < _NEAR
    distance[near] = cKDTree(samples).query(np.argwhere(near))[0]
    return np.where(inside, -distance, distance)


def visual_hull(points: mi.Point3f, views: PinholeViews, alphas: list[np.ndarray], *,
                daylight_votes: float = 0.06, progress=None) -> mi.Float:
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
    votes = max(2, round(daylight_votes * len(views)))
    carved = dr.full(mi.Float, -dr.inf, dr.width(points))
    # The largest distances to the unfilled masks, sorted: the last one has `votes` supporters.
    daylight = [dr.full(mi.Float, -dr.inf, dr.width(points)) for _ in range(votes)]
    for index, alpha in enumerate(alphas):
        whole = not _touches_border(alpha)
        filled = plain = _cone_distance(points, views, index, mask_distance(alpha), whole)
        if _has_holes(alpha):
            plain = _cone_distance(points, views, index, mask_distance(alpha, fill_holes=False), whole)
        carved = dr.maximum(carved, filled)
        for rank in range(votes):
            daylight[rank], plain = dr.maximum(daylight[rank], plain), dr.minimum(daylight[rank], plain)
        dr.eval(carved, daylight)
        if progress:
            progress()
    distance = dr.maximum(carved, daylight[-1])
    return dr.select(distance == -dr.inf, dr.inf, distance)


def _has_holes(alpha: np.ndarray) -> bool:
    inside = alpha >= 0.5
    return bool((ndimage.binary_fill_holes(inside) & ~inside).any())


def _touches_border(alpha: np.ndarray) -> bool:
    return bool(max(alpha[[0, -1]].max(), alpha[:, [0, -1]].max()) >= 0.5)


def _cone_distance(points: mi.Point3f, views: PinholeViews, index: int, outline: np.ndarray,
                   whole: bool) -> mi.Float:
    """Distance to the cone over a mask, to first order.

    Where the view does not frame a point it is -inf, unless the view shows the ``whole`` object: then
    it is that at the frame's border, and behind the camera that to the cone's apex.
    """
    height, width = outline.shape
    film, depth = views.project(index, points)
    # A finite stand-in keeps the interpolation next to an empty mask free of NaN.
    diagonal = float(np.hypot(width, height))
    texture = mi.Texture2f(mi.TensorXf(np.clip(outline, -diagonal, diagonal)[..., None].astype(np.float32)),
                           wrap_mode=dr.WrapMode.Clamp)
    pixel = float(np.linalg.norm(views.bases[index][:, 0]) / width)
    distance = texture.eval(film)[0] * depth * pixel
    if whole:
        return dr.select(depth > 0, distance, dr.norm(points - mi.Point3f(views.origins[index])))
    framed = (depth > 0) & (film.x >= 0) & (film.x <= 1) & (film.y >= 0) & (film.y <= 1)
    return dr.select(framed, distance, -dr.inf)
