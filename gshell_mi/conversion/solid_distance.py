"""Signed distances to a template whose vertices have moved; it may be thin and may intersect itself."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from scipy import ndimage

from ..compat import mesh_scene
from ..fields.lattice_fields import closed_at_border
from ..lattice import Lattice
from .mesh_distance import MeshFeet, nearest_faces

#: Distances are exact up to this many cells from the template.
_BAND = 2.5

#: Inside, up to this many cells from a solid side, the distance is that to the solid side.
_SOLID_BAND = 1.2


def solid_distance(
    vertices: np.ndarray, faces: np.ndarray, solid: np.ndarray, lattice: Lattice
) -> np.ndarray:
    """Signed distance to a watertight mesh; inside thin parts, to the side that is solid.

    A lattice has but one vertex between the two sides of a thin part, whose value can place only one of them
    right.

    Args:
        vertices: (V, 3) in lattice units.
        faces: (F, 3), oriented outwards.
        solid: (V,) False where the template is open.
        lattice: where to sample.

    Returns:
        One value per lattice vertex, lattice units; negative where the mesh winds around it.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points = np.array(lattice.points(mi.Float)).T
    band, face = nearest_faces(mesh, lattice, _BAND * lattice.spacing)
    distance = MeshFeet(mesh)(points[band], face[:, None]).distance
    field = np.full(lattice.vertex_count, np.nan)
    field[band] = np.where(_inside(vertices, faces, points[band]), -distance, distance)

    sheet = trimesh.Trimesh(vertices, faces[solid[faces].all(axis=1)], process=False)
    if len(sheet.faces):
        near, face = nearest_faces(sheet, lattice, _SOLID_BAND * lattice.spacing)
        feet = MeshFeet(sheet)(points[near], face[:, None])
        under = (field[near] < 0) & (feet.height < 0) & ~feet.on_rim
        field[near[under]] = -feet.distance[under]

    for grid in lattice.grids:
        part = field[grid.ids].reshape((grid.stride,) * 3)
        away, nearest = ndimage.distance_transform_edt(np.isnan(part), return_indices=True)
        part = part[tuple(nearest)]
        field[grid.ids] = (part + np.sign(part) * away * grid.spacing).ravel()
    return closed_at_border(field, lattice)


def _inside(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether the mesh winds around each point, by the crossings of a ray.

    The majority of three rays decides, as one may slip through an edge.
    """
    scene, offset = mesh_scene(vertices, faces), 1e-5
    a, b, c = (mi.Point3f(np.ascontiguousarray(vertices[faces[:, i]].T, np.float32)) for i in range(3))
    normals = dr.ravel(dr.cross(b - a, c - a))
    votes = np.zeros(len(points), int)
    for direction in np.random.default_rng(0).normal(size=(3, 3)):
        d = dr.normalize(mi.Vector3f(direction.tolist()))
        ray = mi.Ray3f(mi.Point3f(np.ascontiguousarray(points.T, np.float32)), d)
        winding, active = mi.Int32(0), dr.full(mi.Bool, True, len(points))
        while dr.any(active):
            hit = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            active = hit.is_valid()
            leaving = dr.dot(dr.gather(mi.Vector3f, normals, hit.prim_index, active), d) > 0
            winding += dr.select(active, dr.select(leaving, 1, -1), 0)
            ray.o = dr.select(active, ray.o + d * (hit.t + offset), ray.o)
            dr.eval(winding, active, ray)
        votes += winding.numpy() > 0
    return votes >= 2
