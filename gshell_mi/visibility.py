"""Which points of a surface the cameras see."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .compat import mesh_scene
from .views import PinholeViews

#: A point is seen if nothing is nearer to the camera than this fraction of its distance.
_UNTIL = 0.999


def seen(points: np.ndarray, surface: tuple[np.ndarray, np.ndarray], views: PinholeViews) -> np.ndarray:
    """(n,) whether some view frames a point with nothing before it, from whichever side of the surface.

    Args:
        points: (n, 3) on the surface, world units.
        surface: (V, 3) vertices and (F, 3) faces.
        views: the cameras.
    """
    scene = mesh_scene(*surface)
    target = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    result = dr.full(mi.Bool, False, len(points))
    for view in range(len(views)):
        film, depth = views.project(view, target)
        framed = (depth > 0) & (film.x >= 0) & (film.x <= 1) & (film.y >= 0) & (film.y <= 1)
        origin = views.origins_of(dr.opaque(mi.UInt32, view))
        ray = mi.Ray3f(origin, target - origin, _UNTIL, 0.0, mi.Color0f())
        result |= framed & ~scene.ray_test(ray, framed)
        dr.eval(result)
    return result.numpy()
