"""How well the cameras see the points of a surface."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .compat import mesh_scene
from .views import PinholeViews

#: A point is seen if nothing is nearer to the camera than this fraction of its distance.
_UNTIL = 0.999

#: Least cosine between a normal and the direction to a camera that tells of colours there: beyond, texture is
#: foreshortened to nothing.
GRAZING = 0.3


def is_visible(scene: mi.Scene, views: PinholeViews, view: mi.UInt32 | int, points: mi.Point3f) -> mi.Bool:
    """Whether a view frames points and nothing is before them."""
    film, depth = views.project(view, points)
    framed = (depth > 0) & (film.x >= 0) & (film.x <= 1) & (film.y >= 0) & (film.y <= 1)
    origin = views.origins_of(view)
    return framed & ~scene.ray_test(mi.Ray3f(origin, points - origin, _UNTIL, 0.0, mi.Color0f()), framed)


def hidden(scene: mi.Scene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(n,) whether something is in the way from (n, 3) origins along (n, 3) directions."""
    origin, direction = (np.ascontiguousarray(array.T, np.float32) for array in (origins, directions))
    return np.array(scene.ray_test(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))))


def best_view(
    points: np.ndarray, normals: np.ndarray, surface: tuple[np.ndarray, np.ndarray], views: PinholeViews
) -> np.ndarray:
    """(n,) how squarely points of a surface are seen, from whichever side: 1 along the normal, 0 not at all.

    That is the greatest cosine between the normal and the direction to a camera which frames the point and
    has nothing before it.

    Args:
        points: (n, 3) on the surface, world units.
        normals: (n, 3) unit vectors.
        surface: (V, 3) vertices and (F, 3) faces.
        views: the cameras.
    """
    scene = mesh_scene(*surface)
    target = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    normal = mi.Vector3f(np.ascontiguousarray(normals.T, np.float32))
    result = dr.zeros(mi.Float, len(points))
    for view in range(len(views)):
        index = dr.opaque(mi.UInt32, view)
        seen = is_visible(scene, views, index, target)
        cosine = dr.abs(dr.dot(normal, dr.normalize(target - views.origins_of(index))))
        result = dr.select(seen, dr.maximum(result, cosine), result)
        dr.eval(result)
    return result.numpy()
