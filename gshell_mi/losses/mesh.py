"""Smoothness along a mesh: of values at its vertices, and of the surface itself."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..extraction.surface_mesh import gather
from ..means import mean


def edge_smoothness(values: mi.Color3f | mi.Float, faces: mi.Vector3u) -> mi.Float:
    """Mean absolute difference of vertex values along the faces' edges."""
    corners = [gather(type(values), values, faces[i]) for i in range(3)]
    return sum(mean(dr.abs(corners[i] - corners[i - 1])) for i in range(3)) / 3


def normal_variation(normals: mi.Vector3f, faces: mi.Vector3u) -> mi.Float:
    """Mean squared difference of unit vertex normals along the faces' edges: a bending energy.

    Unlike a Laplacian of the positions it does not shrink the surface along itself, and vertices that
    marching tetrahedra left close together do not count for more.

    Args:
        normals: one per vertex.
        faces: vertex indices.
    """
    corners = [gather(type(normals), normals, faces[i]) for i in range(3)]
    return sum(mean(dr.squared_norm(corners[i] - corners[i - 1])) for i in range(3)) / 3
