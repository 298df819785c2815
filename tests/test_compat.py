"""Scenes of one mesh: what their rays hit, before and after it moves."""

import mitsuba as mi
import numpy as np
import trimesh

from gshell_mi.compat import mesh_scene, move_mesh


def test_rays_of_a_mesh_scene_hit_the_faces_of_the_mesh_wherever_it_is():
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    scene = mesh_scene(vertices, faces)
    weights = np.array([0.2, 0.3, 0.5])
    for shift in ([0, 0, 0], [0.4, -0.3, 0.2]):
        moved = (vertices + shift).astype(np.float32)
        move_mesh(scene, mi.Float(moved.ravel()))
        inner = np.einsum("k,fkc->cf", weights, moved[faces])
        centre = np.array(shift, np.float32)[:, None]
        outside = centre + 2 * (inner - centre)
        hit = scene.ray_intersect_preliminary(
            mi.Ray3f(
                mi.Point3f(outside.astype(np.float32)), mi.Vector3f((centre - outside).astype(np.float32))
            )
        )
        np.testing.assert_array_equal(hit.prim_index, np.arange(len(faces)))
        np.testing.assert_allclose(hit.t, 0.5, rtol=1e-4)
        np.testing.assert_allclose(
            np.array(hit.prim_uv), np.repeat(weights[1:, None], len(faces), 1), atol=1e-3
        )
