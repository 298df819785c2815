"""How far a mesh's silhouette is from the outlines of the masks."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from ..fields.mask_distances import MaskDistances
from ..targets import Target
from ..topology import mesh_edges
from .normals import vertex_normals

#: A contour point belongs to the outer silhouette if the ray this many pixels beyond it meets nothing.
_CLEARANCE = 1.5

#: Contour points farther than this from the mask's outline, in pixels, do not know which outline is theirs.
_REACH = 6.0

#: Pixels around what is unknown in which an outline may be that of the unknown.
_AROUND = 3


class Outlines:
    """The silhouette of a closed mesh against the masks of all views.

    Contour points lie where the interpolated vertex normal is perpendicular to the line of sight, which
    is on edges and not at vertices: that has no bias towards the outside (Hertzmann and Zorin 2000).

    Args:
        masks: of all views.
        targets: their images; masks' outlines that are unknown, or beside what is, do not count.
        faces: (F, 3) vertex indices of a watertight mesh.
        solid: (V,) False for vertices that are no surface; edges with such a vertex do not count.
    """

    def __init__(self, masks: MaskDistances, targets: list[Target], faces: np.ndarray, solid: np.ndarray):
        self.views, self._masks = masks.views, masks
        self._faces = mi.Vector3u(faces.T.astype(np.uint32))
        edges, _ = mesh_edges(faces)
        edges = edges[solid[edges].all(axis=1)]
        self._edges = mi.Vector2u(edges.T.astype(np.uint32))
        self._edge_count = len(edges)
        unknown = mi.Bool(np.concatenate([_beside_unknown(target).ravel() for target in targets]))
        farthest = float(np.hypot(*self.views.sizes.max(axis=0)))
        self._distances = dr.select(unknown, farthest, masks.plain)

    def loss(self, positions: mi.Float, scene: mi.Scene, chosen: np.ndarray) -> mi.Float:
        """Mean squared distance of silhouette points to the masks' outlines.

        Args:
            positions: (3 V,) attached world positions.
            scene: holds the mesh at these positions.
            chosen: indices of the views to look from.

        Returns:
            World units, squared; 0 if nothing is on the silhouette.
        """
        count = dr.opaque(mi.UInt32, self._edge_count)
        lane = dr.arange(mi.UInt32, len(chosen) * self._edge_count)
        view = dr.gather(mi.UInt32, mi.UInt32(chosen), lane // count)
        edge = dr.gather(mi.Vector2u, self._edges, lane % count)
        normals = vertex_normals(dr.detach(positions), self._faces)
        origin = self.views.origins_of(view)
        with dr.suspend_grad():
            ends = [dr.gather(mi.Point3f, positions, edge[i]) for i in range(2)]
            turned = [dr.gather(mi.Vector3f, normals, edge[i]) for i in range(2)]
            facing = [dr.dot(turned[i], origin - ends[i]) for i in range(2)]
            t = dr.select(facing[0] == facing[1], 0, facing[0] / (facing[0] - facing[1]))
            crossing = (facing[0] > 0) != (facing[1] > 0)
        # Few edges carry contour: the rest of the work is done for them alone.
        lane = dr.compress(crossing)
        view, origin, t = (dr.gather(type(x), x, lane) for x in (view, origin, t))
        edge = dr.gather(mi.Vector2u, edge, lane)
        ends = [dr.gather(mi.Point3f, positions, edge[i], mode=dr.ReduceMode.Local) for i in range(2)]
        turned = [dr.gather(mi.Vector3f, normals, edge[i]) for i in range(2)]
        point = ends[0] * (1 - t) + ends[1] * t
        film, depth = self.views.project(view, point)
        pixel = self.views.pixel_size(view) * dr.detach(depth)
        distance = self._masks.at(self._distances, view, film)
        near = (depth > 0) & (dr.abs(dr.detach(distance)) < _REACH)
        beyond = dr.detach(point) + dr.normalize(dr.lerp(*turned, t)) * (_CLEARANCE * pixel)
        ray = mi.Ray3f(origin, dr.normalize(beyond - origin))
        outer = near & ~scene.ray_test(ray, coherent=False, active=near)
        dr.eval(outer)  # or both sums and the derivatives would trace rays
        squares = dr.select(outer, dr.square(distance * pixel), 0)
        return dr.sum(squares) / dr.maximum(dr.sum(dr.select(outer, mi.Float(1), 0)), 1)


def _beside_unknown(target: Target) -> np.ndarray:
    """(height, width) what is unknown of an image, and the pixels around."""
    unknown = np.asarray(target.known) < 0.5
    return ndimage.binary_dilation(unknown, iterations=_AROUND) if unknown.any() else unknown
