"""Which parts of a fitted surface its views saw."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

from ..export.fitted_scene import load_fitted_scene
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
    points, face = surface_points(mesh, _POINTS)
    world = points @ back[:3, :3].T + back[:3, 3]
    normals = mesh.face_normals[face]
    seen = np.zeros(len(points), bool)
    lift = _LIFT * float(back[0, 0])
    for sensor in scene.sensors():
        to_world = np.array(sensor.world_transform().matrix, float).reshape(4, 4)
        eye = to_world[:3, 3]
        local = (world - eye) @ to_world[:3, :3]
        parameters = mi.traverse(sensor)
        half = np.tan(np.radians(float(np.ravel(parameters["x_fov"])[0])) / 2)
        height = float(sensor.film().size()[1]) / float(sensor.film().size()[0])
        inside = (
            (local[:, 2] > 0)
            & (np.abs(local[:, 0]) < half * local[:, 2])
            & (np.abs(local[:, 1]) < half * height * local[:, 2])
        )
        if not inside.any():
            continue
        toward = eye - world[inside]
        distance = np.linalg.norm(toward, axis=1)
        toward /= distance[:, None]
        side = np.sign(np.einsum("ij,ij->i", toward, normals[inside]))[:, None]
        origin = world[inside] + lift * side * normals[inside]
        start, way = (np.ascontiguousarray(np.asarray(x).T, np.float32) for x in (origin, toward))
        ray = mi.Ray3f(mi.Point3f(start), mi.Vector3f(way))
        ray.maxt = mi.Float(distance.astype(np.float32))
        seen[np.flatnonzero(inside)[~scene.ray_test(ray).numpy()]] = True
    return np.concatenate([points, seen[:, None]], axis=1)
