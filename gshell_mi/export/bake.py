"""Textures of a mesh, taken from the vertices of another that lies close to it."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from ..compat import mesh_scene
from ..images import srgb
from ..triangles import area_vectors, unit
from .ply import FittedMesh

_OCCLUSION_RAYS = 64


@dataclass(frozen=True)
class Textures:
    """8-bit images of shape (size, size, 3), first row on top (v = 1), as glTF 2.0 defines them.

    Attributes:
        base_color: sRGB.
        occlusion_roughness_metallic: linear; R, G and B.
        normal: tangent space, +y up (OpenGL's convention); (v + 1) / 2.
    """

    base_color: np.ndarray
    occlusion_roughness_metallic: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a mesh: face indices (N,) and barycentric weights (N, 3)."""

    faces: np.ndarray
    weights: np.ndarray

    def interpolate(self, mesh_faces: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Values at the points from (V, ...) ``values`` at the vertices."""
        corners = values[mesh_faces[self.faces]]
        return np.einsum("nk,nk...->n...", self.weights, corners)


def bake(
    fine: FittedMesh,
    vertices: np.ndarray,
    normals: np.ndarray,
    tangents: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    size: int,
) -> Textures:
    """Textures for the mesh ``(vertices, faces)`` with material and normals of ``fine``.

    Each texel looks along its normal, to both sides, for the nearest point of the fine mesh that faces the
    same way. Gutters between charts repeat the nearest texel.

    Args:
        fine: the mesh with the attributes ``color`` (linear), ``roughness`` and ``metallic``.
        vertices, normals: (V, 3).
        tangents: (V, 4), the last number the sign of the bitangent.
        faces: (F, 3).
        uv: (V, 2) in [0, 1], v upwards.
        size: pixels per side.
    """
    filled, at = _texels(faces, uv, size)
    normal = unit(at.interpolate(faces, normals))
    source = project(fine, at.interpolate(faces, vertices), normal)
    occlusion = source.interpolate(fine.faces, openness(fine))
    color = source.interpolate(fine.faces, fine.attributes["color"])
    roughness, metallic = (
        source.interpolate(fine.faces, fine.attributes[name]) for name in ("roughness", "metallic")
    )
    # Interpolated but not normalised, as renderers do (MikkTSpace).
    tangent = at.interpolate(faces, tangents[:, :3])
    bitangent = at.interpolate(faces, tangents[:, 3:] * np.cross(normals, tangents[:, :3]))
    frame = np.stack([tangent, bitangent, at.interpolate(faces, normals)], axis=-1)
    fine_normal = unit(source.interpolate(fine.faces, fine.normals))
    # A frame may degenerate where tangents oppose each other.
    usable = np.abs(np.linalg.det(frame)) > 1e-3
    frame[~usable], fine_normal[~usable] = np.eye(3), [0, 0, 1]
    local = unit(np.linalg.solve(frame, fine_normal[..., None])[..., 0])
    local = np.where(local[:, 2:] > 0, local, [0.0, 0.0, 1.0])
    images = (srgb(color), np.stack([occlusion, roughness, metallic], axis=-1), 0.5 * local + 0.5)
    return Textures(*(_image(values, filled) for values in images))


def project(fine: FittedMesh, points: np.ndarray, normals: np.ndarray) -> SurfacePoints:
    """For each of (N, 3) points the nearest point of ``fine`` along its normal, on either side, that faces
    the same way; without one the nearest vertex."""
    scene = mesh_scene(fine.vertices, fine.faces)
    geometric = unit(area_vectors(fine.vertices, fine.faces))
    best = np.full(len(points), np.inf)
    index, weights = np.zeros(len(points), np.int64), np.zeros((len(points), 3))
    for sign in (1.0, -1.0):
        hit = scene.ray_intersect_preliminary(mi.Ray3f(_point(points), mi.Vector3f(_point(sign * normals))))
        distance, prim = np.array(hit.t), np.array(hit.prim_index).astype(np.int64)
        u, v = (np.array(x) for x in (hit.prim_uv.x, hit.prim_uv.y))
        prim = np.where(np.isfinite(distance), prim, 0)
        nearer = (distance < best) & ((geometric[prim] * normals).sum(1) > 0)
        best = np.where(nearer, distance, best)
        index = np.where(nearer, prim, index)
        weights = np.where(nearer[:, None], np.stack([1 - u - v, u, v], axis=1), weights)
    # Far hits belong to another part of the surface; along the boundary there may be none.
    tree = cKDTree(fine.vertices)
    distance, vertex = tree.query(points)
    lost = best > 2 * distance + 1e-12
    corner_of = np.zeros(len(fine.vertices), np.int64)
    corner_of[fine.faces.ravel()] = np.arange(fine.faces.size)
    corner = corner_of[vertex[lost]]
    index[lost], weights[lost] = corner // 3, np.eye(3)[corner % 3]
    return SurfacePoints(index, weights)


def openness(mesh: FittedMesh) -> np.ndarray:
    """Ambient occlusion in glTF's sense: the cosine-weighted fraction of the directions on the front of each
    vertex in which no surface is hit; (V,)."""
    scene = mesh_scene(mesh.vertices, mesh.faces)
    count = len(mesh.vertices)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count * _OCCLUSION_RAYS)
    index = dr.arange(mi.UInt32, count * _OCCLUSION_RAYS) // _OCCLUSION_RAYS
    normal = dr.gather(mi.Normal3f, mi.Float(mesh.normals.astype(np.float32).ravel()), index)
    point = dr.gather(mi.Point3f, mi.Float(mesh.vertices.astype(np.float32).ravel()), index)
    local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    direction = mi.Frame3f(normal).to_world(local)
    # Off the faces around the vertex, whose normals differ from the vertex's.
    offset = 1e-3 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    hit = scene.ray_test(mi.Ray3f(point + offset * normal, direction))
    return np.array(dr.block_sum(dr.select(hit, mi.Float(0), mi.Float(1)), _OCCLUSION_RAYS)) / _OCCLUSION_RAYS


def vertex_tangents(
    vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, uv: np.ndarray
) -> np.ndarray:
    """(V, 4) unit tangents along u, orthogonal to the normals, with the bitangent's sign: bitangent =
    sign · normal x tangent, as glTF 2.0 defines it."""
    p0, p1, p2 = (vertices[faces[:, i]] for i in range(3))
    t0, t1, t2 = (uv[faces[:, i]] for i in range(3))
    (du1, dv1), (du2, dv2) = (t1 - t0).T, (t2 - t0).T
    determinant = du1 * dv2 - du2 * dv1
    orientation = np.sign(determinant)[:, None]
    along_u = orientation * ((p1 - p0) * dv2[:, None] - (p2 - p0) * dv1[:, None])
    tangents, signs = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for corner in range(3):
        np.add.at(tangents, faces[:, corner], unit(along_u) * np.sqrt(np.abs(determinant))[:, None])
        np.add.at(signs, faces[:, corner], determinant)
    tangents = unit(tangents - (tangents * normals).sum(1, keepdims=True) * normals)
    lost = np.abs((tangents**2).sum(1) - 1) > 1e-3
    if lost.any():  # any direction in the tangent plane will do
        axis = np.eye(3)[np.abs(normals[lost]).argmin(1)]
        tangents[lost] = unit(np.cross(normals[lost], axis))
    return np.concatenate([tangents, np.where(signs < 0, -1.0, 1.0)[:, None]], axis=1)


def _texels(faces: np.ndarray, uv: np.ndarray, size: int) -> tuple[np.ndarray, SurfacePoints]:
    """Which texels (size, size) a chart covers, and the point of the mesh at each of these."""
    flat = np.concatenate([uv, np.zeros((len(uv), 1))], axis=1)
    scene = mesh_scene(flat, faces)
    row, column = np.divmod(np.arange(size * size), size)
    x, y = (column + 0.5) / size, 1 - (row + 0.5) / size
    origin = np.stack([x, y, np.ones(size * size)], axis=1)
    hit = scene.ray_intersect_preliminary(mi.Ray3f(_point(origin), mi.Vector3f(0, 0, -1)))
    filled = np.isfinite(np.array(hit.t))
    u, v = (np.array(x)[filled] for x in (hit.prim_uv.x, hit.prim_uv.y))
    return filled.reshape(size, size), SurfacePoints(
        np.array(hit.prim_index)[filled].astype(np.int64), np.stack([1 - u - v, u, v], axis=1)
    )


def _image(values: np.ndarray, filled: np.ndarray) -> np.ndarray:
    image = np.zeros((*filled.shape, 3))
    image[filled] = values
    nearest = distance_transform_edt(~filled, return_distances=False, return_indices=True)
    return (np.clip(image[tuple(nearest)], 0, 1) * 255 + 0.5).astype(np.uint8)


def _point(values: np.ndarray) -> mi.Point3f:
    return mi.Point3f(np.ascontiguousarray(values.T, np.float32))
