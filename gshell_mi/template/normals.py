"""Normals of meshes whose vertices move."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def vertex_normals(positions: mi.Float, faces: mi.Vector3u) -> mi.Float:
    """Normals at the vertices, as long as twice the area around them.

    Args:
        positions: (3 V,) x0, y0, z0, x1, ...
        faces: vertex indices.

    Returns:
        (3 V,) in the order of the positions.
    """
    a, b, c = (dr.gather(mi.Point3f, positions, index) for index in faces)
    normal = dr.cross(b - a, c - a)
    total = dr.zeros(mi.Float, dr.width(positions))
    for index in faces:
        dr.scatter_add(total, normal, index)
    return total
