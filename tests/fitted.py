"""A fitted object with known answers: a sphere of radius 0.6, open at the top, coloured by position."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

from gshell_mi.export.ply import FittedMesh, write_ply
from gshell_mi.export.stock_scene import write_scene

RADIUS = 0.6


def color_at(points: np.ndarray) -> np.ndarray:
    """Linear base colour."""
    return 0.5 + 0.6 * points


def open_sphere(subdivisions: int = 4) -> FittedMesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    faces = ball.faces[ball.triangles_center[:, 1] < 0.3]
    used, faces = np.unique(faces, return_inverse=True)
    vertices = np.asarray(ball.vertices[used])
    attributes = {
        "color": color_at(vertices),
        "roughness": np.full(len(vertices), 0.3),
        "metallic": np.full(len(vertices), 0.1),
    }
    return FittedMesh(vertices, faces.reshape(-1, 3), vertices / RADIUS, attributes)


def write_fit(folder: Path, mesh: FittedMesh, up=(0, 1, 0), views: int = 6, size: int = 48) -> Path:
    """The files of a fit's folder that describe the object, its light (uniform) and its views."""
    write_ply(folder / "mesh.ply", mesh.vertices, mesh.faces, mesh.normals, mesh.attributes)
    write_ply(
        folder / "template.ply",
        mesh.vertices,
        mesh.faces,
        mesh.normals,
        {"msdf": np.ones(len(mesh.vertices))},
    )
    mi.Bitmap(np.ones((8, 16, 3), np.float32)).write(str(folder / "light.exr"))
    side = np.roll(up, 1)
    sensors = []
    for number, angle in enumerate(np.linspace(0, 2 * np.pi, views, endpoint=False)):
        at = 2.5 * (np.cos(angle) * side + np.sin(angle) * np.cross(up, side) + 0.5 * np.array(up))
        sensors.append(
            mi.load_dict(
                {
                    "type": "perspective",
                    "id": f"view_{number:03}",
                    "fov": 40,
                    "to_world": mi.ScalarTransform4f().look_at(list(at), [0, 0, 0], list(up)),
                    "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba"},
                }
            )
        )
    write_scene(folder / "scene.xml", mi.load_dict({"type": "constant"}), sensors)
    return folder
