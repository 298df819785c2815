"""The meshes of the live view as glTF."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..export.asset import vertex_normals
from ..export.gltf import Part
from ..report.viewer_model import back_faces

if TYPE_CHECKING:
    from ..fit import Preview


def mesh_parts(preview: Preview) -> list[Part]:
    """The open mesh in its colours, its back faces in orange; nothing if it has no faces."""
    if len(preview.faces) == 0:
        return []
    used, faces = np.unique(preview.faces, return_inverse=True)
    faces, positions = faces.reshape(-1, 3), preview.vertices[used]
    normals = vertex_normals(positions, faces)
    front = {"POSITION": positions, "NORMAL": normals, "COLOR_0": np.clip(preview.colors[used], 0, 1)}
    return [Part("open mesh", faces, front, _matte([1, 1, 1, 1])), back_faces(positions, normals, faces)]


def template_part(preview: Preview) -> list[Part]:
    """The template, translucent."""
    if len(preview.template_faces) == 0:
        return []
    normals = vertex_normals(preview.template_vertices, preview.template_faces)
    return [
        Part(
            "template",
            preview.template_faces,
            {"POSITION": preview.template_vertices, "NORMAL": normals},
            _matte([0.25, 0.4, 0.7, 0.35]) | {"alphaMode": "BLEND"},
        )
    ]


def _matte(color: list[float]) -> dict:
    return {"pbrMetallicRoughness": {"baseColorFactor": color, "metallicFactor": 0, "roughnessFactor": 0.9}}
