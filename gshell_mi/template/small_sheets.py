"""Closed parts of a template that are nothing but a small sheet, such as an island in the hole of lace.

Few of their vertices lie within the sheet; at its edge normals turn from one side to the other. So whether
they are sheets is judged by volume and area, and their sides are parted by a plane.
"""

from __future__ import annotations

import numpy as np
import trimesh

from ..topology import mesh_components


def small_sheets(moved: np.ndarray, normals: np.ndarray, faces: np.ndarray, others: np.ndarray,
                 thickness: float) -> tuple[np.ndarray, int]:
    """One side of each, and their number.

    Args:
        moved: (V, 3) positions.
        normals: (V, 3) of the template before it moved; a sheet's sides may have moved through each other.
        faces: (F, 3) of the watertight template, oriented outwards.
        others: (V,) parts with one of these are left out.
        thickness: mean thickness, twice the volume by the area, up to which a part is a sheet.

    >>> box = trimesh.creation.box(extents=(1, 1, 0.1))
    >>> normals, none = np.array(box.vertex_normals), np.zeros(8, bool)
    >>> side, count = small_sheets(np.array(box.vertices), normals, box.faces, none, 0.1)
    >>> count, np.ptp(box.vertices[side, 2]).item(), side.sum().item()
    (1, 0.0, 4)
    >>> small_sheets(np.array(box.vertices), normals, box.faces, none, 0.05)[1]
    0
    """
    part = mesh_components(faces, len(moved))
    side, count = np.zeros(len(moved), bool), 0
    for index in np.flatnonzero(np.bincount(part, others) == 0):
        mesh = trimesh.Trimesh(moved, faces[part[faces[:, 0]] == index], process=False)
        if 2 * mesh.volume < thickness * mesh.area:
            # Across the sheet: along it, the squares of its faces' normals are greatest.
            weighted = mesh.face_normals * np.sqrt(mesh.area_faces)[:, None]
            across = np.linalg.svd(weighted, full_matrices=False)[2][0]
            side |= (part == index) & (normals @ across > 0)
            count += 1
    return side, count
