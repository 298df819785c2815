"""Closed parts of a template that are nothing but a small sheet, such as an island in the hole of lace.

Few of their vertices lie within the sheet; at its edge normals turn from one side to the other. So whether
they are sheets is judged by volume and area, and their sides are parted by a plane.
"""

from __future__ import annotations

import numpy as np
import trimesh

from ..topology import boundary_edges, mesh_components
from ..triangles import vertex_areas

#: A loose part is smaller than this fraction of the template.
_LOOSE = 0.05

#: Mean thickness, in cells, up to which a loose part is a sheet; lattices hold none thinner than one.
_SHEET = 1.5


def small_sheets(
    moved: np.ndarray, normals: np.ndarray, faces: np.ndarray, others: np.ndarray, thickness: float
) -> tuple[np.ndarray, int]:
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


def loose_sheets(
    vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, opened: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """One side (V,) of each small part that is a closed sheet, and both (V,); none if the surface is closed.

    What such a part borders of openings must be small beside it, as a neck that has been cut, by which the
    template joins it to more than itself.

    Args:
        vertices, normals: (V, 3) of the template.
        faces: (F, 3) of the watertight template, oriented outwards.
        opened: (V,) where it is open.
        cell: side of a lattice cell, in the unit of the vertices.
    """
    if opened.all() or not opened.any():
        return np.zeros(len(vertices), bool), np.zeros(len(vertices), bool)
    areas = vertex_areas(vertices, faces)
    whole, faces = areas.sum(), faces[~opened[faces].any(axis=1)]
    part = mesh_components(faces, len(vertices))
    area = np.bincount(part, areas)
    start, end = boundary_edges(faces)[0].T
    rim = np.bincount(part[start], np.linalg.norm(vertices[end] - vertices[start], axis=1), len(area))
    # Any flat piece has twice that rim or more.
    left_out = ((area > _LOOSE * whole) | (rim**2 >= np.pi * area))[part]
    left_out |= np.bincount(faces.ravel(), minlength=len(vertices)) == 0
    side, _ = small_sheets(vertices, normals, faces, left_out, _SHEET * cell)
    return side, np.isin(part, part[side])
