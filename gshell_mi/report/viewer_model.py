"""The model that the report's 3-D view shows: a glTF with a material per thing that can be switched."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import UserError, last_line
from ..export.asset import y_up_turn
from ..export.gltf import Part, glb_bytes, read_part
from ..export.ply import read_ply
from ..mesh_files import check_triangles
from ..topology import mesh_edges
from ..triangles import unit
from ..turntable.looks import ORANGE

_TUBE_SIDES = 5

#: Radius of the tubes along boundary loops, as a fraction of the bounding box's diagonal.
_TUBE_RADIUS = 0.003


def viewer_model(folder: Path) -> bytes:
    """``mesh.glb`` with its back faces in orange, the template and the boundary loops as further materials.

    ``back faces``, ``template`` and ``boundary loops`` name the materials; the template starts invisible.

    Raises:
        UserError: a file of the fit is missing or damaged.
    """
    base, subject = _subject(folder / "mesh.glb")
    turn = y_up_turn(folder)
    mesh, template = read_ply(folder / "mesh.ply"), read_ply(folder / "template.ply")
    diagonal = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    parts = [back_faces(subject.attributes["POSITION"], subject.attributes["NORMAL"], subject.indices)]
    if len(template.faces):
        parts.append(
            Part(
                "template",
                template.faces,
                {"POSITION": template.vertices @ turn.T, "NORMAL": template.normals @ turn.T},
                {
                    "pbrMetallicRoughness": {
                        "baseColorFactor": [0.25, 0.4, 0.7, 0],
                        "metallicFactor": 0,
                        "roughnessFactor": 0.6,
                    },
                    "alphaMode": "BLEND",
                },
            )
        )
    tubes = boundary_tubes(mesh.vertices @ turn.T, mesh.faces, _TUBE_RADIUS * float(diagonal))
    if tubes:
        parts.append(
            Part(
                "boundary loops",
                tubes[1],
                {"POSITION": tubes[0]},
                {
                    "pbrMetallicRoughness": {
                        "baseColorFactor": [0.6, 0, 0.25, 1],
                        "metallicFactor": 0,
                        "roughnessFactor": 1,
                    },
                    "emissiveFactor": [0.5, 0, 0.2],
                    "alphaMode": "MASK",
                    "doubleSided": True,
                },
            )
        )
    return glb_bytes(parts, base)


def _subject(path: Path) -> tuple[bytes, Part]:
    try:
        base = path.read_bytes()
        subject = read_part(base)
        faces, normals = subject.indices, subject.attributes["NORMAL"]
        check_triangles(subject.attributes["POSITION"], faces.astype(np.int64))
        if normals.shape != subject.attributes["POSITION"].shape:
            raise ValueError("its normals are not as many as its vertices")
        return base, subject
    except Exception as error:  # anything may be where a number should be
        raise UserError(
            f"'{path}' is damaged ({last_line(error)}); delete it and make the report again."
        ) from error


def back_faces(positions: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> Part:
    """The other side of a sheet in orange, as the paper shows it."""
    # A hair behind, or the two sides would flicker.
    offset = 3e-4 * np.linalg.norm(np.ptp(positions, axis=0))
    return Part(
        "back faces",
        faces[:, ::-1],
        {"POSITION": positions - offset * normals, "NORMAL": -normals},
        {
            "pbrMetallicRoughness": {
                "baseColorFactor": [*ORANGE, 1],
                "metallicFactor": 0,
                "roughnessFactor": 0.8,
            },
            "alphaMode": "MASK",
        },
    )


def boundary_tubes(
    vertices: np.ndarray, faces: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Thin open prisms along the boundary edges: vertices and faces; None for closed meshes."""
    edges, uses = mesh_edges(faces)
    edges = edges[uses == 1]
    if len(edges) == 0:
        return None
    start, end = vertices[edges[:, 0]], vertices[edges[:, 1]]
    along = unit(end - start)
    across = unit(np.cross(along, np.eye(3)[np.abs(along).argmin(1)]))
    other = np.cross(along, across)
    angle = 2 * np.pi * np.arange(_TUBE_SIDES) / _TUBE_SIDES
    ring = radius * (np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * other[:, None])
    # Reach a little past the ends, so that neighbours leave no gap.
    points = np.concatenate(
        [
            start[:, None] + ring - 0.5 * radius * along[:, None],
            end[:, None] + ring + 0.5 * radius * along[:, None],
        ],
        axis=1,
    )
    i = np.arange(_TUBE_SIDES)
    j = (i + 1) % _TUBE_SIDES
    top_i, top_j = i + _TUBE_SIDES, j + _TUBE_SIDES
    sides = np.concatenate([np.stack([i, j, top_j], 1), np.stack([i, top_j, top_i], 1)])
    offset = 2 * _TUBE_SIDES * np.arange(len(edges))
    return points.reshape(-1, 3), (sides[None] + offset[:, None, None]).reshape(-1, 3)
