"""Which parts of a fitted surface its views saw."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from ..export.fitted_scene import load_fitted_scene
from ..views import PinholeViews
from ..visibility import is_visible
from .surface_points import surface_points

_POINTS = 20_000
#: A point is lifted off the surface by this fraction of the box before it looks for the camera.
_LIFT = 2e-3


def seen_points(folder: Path, mesh: trimesh.Trimesh, back: np.ndarray) -> np.ndarray:
    """(n, 4) points on the mesh, and 1 where a sensor of the fit sees them, 0 elsewhere.

    Args:
        folder: of the fit, whose scene holds the sensors.
        mesh: its surface, in the units of the cube.
        back: 4 x 4 matrix from these to the world.

    Raises:
        UserError: the folder holds no fit.
    """
    scene = load_fitted_scene(folder)
    views = PinholeViews.from_sensors(scene.sensors())
    points, face = surface_points(mesh, _POINTS)
    world = points @ back[:3, :3].T + back[:3, 3]
    normals = mesh.face_normals[face]
    seen = np.zeros(len(points), bool)
    lift = _LIFT * float(back[0, 0])
    for view, eye in enumerate(views.origins):
        # Off the side that faces the camera.
        side = np.sign(np.einsum("ij,ij->i", eye - world, normals))[:, None]
        lifted = mi.Point3f(np.ascontiguousarray((world + lift * side * normals).T, np.float32))
        seen |= is_visible(scene, views, dr.opaque(mi.UInt32, view), lifted).numpy()
    return np.concatenate([points, seen[:, None]], axis=1)
