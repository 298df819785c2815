"""How far a mesh's silhouette is from the outlines of the masks."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from ..fields.mask_outline import mask_distance, sharp
from ..targets import Target
from ..topology import mesh_edges
from ..views import PinholeViews
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
        views: the cameras.
        targets: their images; masks' outlines that are unknown, or beside what is, do not count.
        faces: (F, 3) vertex indices of a watertight mesh.
        solid: (V,) False for vertices that are no surface; edges with such a vertex do not count.
    """

    def __init__(self, views: PinholeViews, targets: list[Target], faces: np.ndarray, solid: np.ndarray):
        self.views = views
        self._faces = mi.Vector3u(faces.T.astype(np.uint32))
        edges, _ = mesh_edges(faces)
        edges = edges[solid[edges].all(axis=1)]
        self._edges = mi.Vector2u(edges.T.astype(np.uint32))
        self._edge_count = len(edges)
        diagonal = float(max(np.hypot(*size) for size in views.sizes))
        alphas = [target.most_alpha for target in targets]
        thin_parts = sharp(alphas)
        distances = [
            mask_distance(alpha, fill_holes=False, thin_parts=thin_parts).clip(-diagonal, diagonal)
            for alpha in alphas
        ]
        distances = [
            np.where(_beside_unknown(target), diagonal, distance)
            for target, distance in zip(targets, distances, strict=True)
        ]
        counts = views.sizes.prod(axis=1)
        self._distances = mi.Float(np.concatenate([d.ravel() for d in distances]).astype(np.float32))
        self._first = mi.UInt32(np.concatenate([[0], np.cumsum(counts)[:-1]]))
        self._size = mi.UInt32(views.sizes.ravel())

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
        distance = self._distance(view, film)
        near = (depth > 0) & (dr.abs(dr.detach(distance)) < _REACH)
        beyond = dr.detach(point) + dr.normalize(dr.lerp(*turned, t)) * (_CLEARANCE * pixel)
        ray = mi.Ray3f(origin, dr.normalize(beyond - origin))
        outer = near & ~scene.ray_test(ray, coherent=False, active=near)
        dr.eval(outer)  # or both sums and the derivatives would trace rays
        squares = dr.select(outer, dr.square(distance * pixel), 0)
        return dr.sum(squares) / dr.maximum(dr.sum(dr.select(outer, mi.Float(1), 0)), 1)

    def _distance(self, view: mi.UInt32, film: mi.Point2f) -> mi.Float:
        """Signed distance to the mask's outline in pixels, interpolated bilinearly."""
        width, height = (dr.gather(mi.UInt32, self._size, 2 * view + i) for i in range(2))
        x, y = film.x * width - 0.5, film.y * height - 0.5
        column = dr.clip(mi.Int32(dr.floor(dr.detach(x))), 0, mi.Int32(width) - 2)
        row = dr.clip(mi.Int32(dr.floor(dr.detach(y))), 0, mi.Int32(height) - 2)
        fx, fy = dr.clip(x - column, 0, 1), dr.clip(y - row, 0, 1)
        corner = dr.gather(mi.UInt32, self._first, view) + mi.UInt32(row) * width + mi.UInt32(column)
        texel = [dr.gather(mi.Float, self._distances, corner + step) for step in (0, 1, width, width + 1)]
        return dr.lerp(dr.lerp(texel[0], texel[1], fx), dr.lerp(texel[2], texel[3], fx), fy)


def _beside_unknown(target: Target) -> np.ndarray:
    """(height, width) what is unknown of an image, and the pixels around."""
    unknown = np.asarray(target.known) < 0.5
    return ndimage.binary_dilation(unknown, iterations=_AROUND) if unknown.any() else unknown
