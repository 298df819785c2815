"""Smoothness along a mesh: of values at its vertices, and of the surface itself."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..extraction.surface_mesh import gather
from ..means import mean

#: Differences of unit normals much smaller than this are flat: half a degree.
_FLAT = 0.01


def edge_smoothness(values: mi.Color3f | mi.Float, faces: mi.Vector3u) -> mi.Float:
    """Mean absolute difference of vertex values along the faces' edges."""
    corners = [gather(type(values), values, faces[i]) for i in range(3)]
    return sum(mean(dr.abs(corners[i] - corners[i - 1])) for i in range(3)) / 3


def normal_variation(normals: mi.Vector3f, faces: mi.Vector3u) -> mi.Float:
    """Mean difference of unit vertex normals along the faces' edges: their total variation (Zhang and others,
    2015), which flattens bumps, and leaves creases and bends as they are.

    Unlike a Laplacian of the positions it does not shrink the surface along itself, and vertices that
    marching tetrahedra left close together do not count for more.

    Args:
        normals: one per vertex.
        faces: vertex indices.
    """
    if not dr.width(faces):
        return mi.Float(0)
    corners = [gather(type(normals), normals, faces[i]) for i in range(3)]
    lengths = (dr.sqrt(dr.squared_norm(corners[i] - corners[i - 1]) + _FLAT**2) - _FLAT for i in range(3))
    return sum(mean(length) for length in lengths) / 3
