"""Edges and silhouettes of meshes: adjacency, projection, culling."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.integrators.edge_table import build_edge_table, scene_edge_tables
from gshell_mi.integrators.shading_rims import shading_rims
from gshell_mi.integrators.silhouette_edges import crease_mask, screen_edges, silhouette_mask
from pipelines import gradient_scenes as scenes


def arrays(vertices, faces):
    return mi.Float(np.ravel(vertices).astype(np.float32)), mi.UInt32(np.ravel(faces).astype(np.uint32))


def open_edges(vertices, faces):
    table = build_edge_table(*arrays(vertices, faces))
    return dr.count(table.degree == 1), dr.count(table.degree == 2)


def test_edge_counts_follow_euler():
    v, f = scenes.sphere(2)
    assert open_edges(v, f) == (0, len(f) * 3 // 2)


def test_boundary_of_open_cylinder():
    v, f = scenes.open_cylinder(n=20, rings=3)
    assert open_edges(v, f)[0] == 40


def test_texture_seam_is_no_boundary():
    v, f, _ = scenes.uv_sphere(n=6)
    assert open_edges(v, f)[0] == 0


def test_padding_is_ignored():
    v, f = scenes.sheet(3)
    padded = np.concatenate([f, np.zeros((7, 3), int), np.full((2, 3), 5)])
    v = np.concatenate([v, np.repeat(v[:1], 9, 0)])
    assert open_edges(v, padded) == open_edges(v, f)


@pytest.mark.parametrize("turn", [[0, 1, 2], [1, 2, 0], [0, 2, 1]])
@pytest.mark.parametrize("mesh", [scenes.sphere(1), scenes.open_cylinder(8, 2)])
def test_repeated_faces_change_nothing(mesh, turn):
    """Whatever their side, with the same vertices or with copies of their own."""
    v, f = mesh
    again = f[:, turn]
    doubled = open_edges(v, np.concatenate([f, again]))
    copied = open_edges(np.concatenate([v, v]), np.concatenate([f, again + len(v)]))
    assert doubled == copied == open_edges(v, f)


def test_silhouette_does_not_depend_on_orientation():
    v, f = scenes.sphere(2)
    flipped = f.copy()
    flipped[::3] = flipped[::3, ::-1]
    counts = []
    for faces in (f, flipped):
        positions, indices = arrays(v, faces)
        table = build_edge_table(positions, indices)
        counts.append(dr.count(silhouette_mask(positions, indices, table, mi.Point3f(0.3, 0.2, 6))))
    assert counts[0] == counts[1] > 8


def test_silhouette_of_a_sphere_closes():
    """Each vertex of the silhouette of a closed mesh has an even number of silhouette edges."""
    v, f = scenes.sphere(3)
    positions, indices = arrays(v, f)
    table = build_edge_table(positions, indices)
    chosen = np.array(silhouette_mask(positions, indices, table, mi.Point3f(0.3, 0.2, 6)))
    ends = np.concatenate([np.array(table.start)[chosen], np.array(table.end)[chosen]])
    assert np.all(np.bincount(ends) % 2 == 0)


def test_creases_of_a_flat_cube():
    scene, _ = scenes._cube(8)
    ((mesh, table),) = scene_edge_tables(scene)
    assert dr.count(crease_mask(mesh, table, 10)) == 12
    assert dr.count(crease_mask(mesh, table, 95)) == 0


def projected_length(scene, **options):
    tables = scene_edge_tables(scene)
    with dr.suspend_grad():
        edges = screen_edges(scene, tables, scene.sensors()[0], 4.0, **options)
    return 0.0 if edges is None else float(dr.sum(dr.norm(edges.b - edges.a))[0])


def test_length_of_a_projected_circle():
    v, f = scenes.sphere(4)
    mesh = scenes.make_mesh("subject", v, f, smooth=False)
    scene = scenes.load(scenes.camera(64), scenes.constant(), mesh)
    tangent = 1 / np.sqrt(5**2 - 1)  # of half the angle under which the sphere is seen
    circumference = 2 * np.pi * tangent * 32 / np.tan(np.deg2rad(20))
    # The silhouette of a polyhedron is a zigzag near that circle.
    assert projected_length(scene, crease_angle=30) == pytest.approx(circumference, rel=0.1)


def test_shading_rim_lies_inside_the_silhouette_and_where_normals_are_at_right_angles():
    v, f = scenes.sphere(2)
    mesh = scenes.make_mesh("subject", v, f)
    params = mi.traverse(mesh)
    params["vertex_normals"] = mi.Float(params["vertex_positions"])
    params.update()
    viewpoint = np.array([0.3, 0.2, 6.0])
    a, b = shading_rims(mesh, mi.Point3f(viewpoint))
    for end in (np.array(a), np.array(b)):
        # Where p = n, n . (o - p) = 0 is the circle p . o = 1; the chords of faces lie inside the sphere.
        assert np.all(viewpoint @ end / np.linalg.norm(end, axis=0) ** 2 == pytest.approx(1, abs=1e-4))


def test_flat_meshes_have_no_shading_rim():
    v, f = scenes.sphere(2)
    assert shading_rims(scenes.make_mesh("subject", v, f, smooth=False), mi.Point3f(0, 0, 6)) is None


def test_hidden_silhouettes_are_culled():
    v, f = scenes.sphere(3, 0.5)
    w, g = scenes.sheet(2, 3.0)
    scene = scenes.load(
        scenes.camera(64),
        scenes.constant(),
        scenes.make_mesh("subject", v, f),
        curtain=scenes.make_mesh("curtain", w + np.array([0, 0, 1.5]), g),
    )
    alone = scenes.load(
        scenes.camera(64), scenes.constant(), scenes.make_mesh("curtain", w + np.array([0, 0, 1.5]), g)
    )
    assert projected_length(scene) == pytest.approx(projected_length(alone), rel=1e-5)
    assert projected_length(scene, cull=False) > projected_length(alone) + 20


@pytest.mark.parametrize("centre", [(0, 0, 9), (0, 0, 5), (100, 0, 0)])
def test_behind_around_and_beside_the_camera(centre):
    v, f = scenes.sphere(2, 1, centre)
    scene = scenes.load(scenes.camera(32), scenes.constant(), scenes.make_mesh("subject", v, f))
    assert projected_length(scene) == 0
