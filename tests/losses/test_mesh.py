"""Smoothness along a mesh."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from closed_form import value

from gshell_mi import losses


def test_edge_smoothness():
    """Differences 1, 2 and 3 along the edges of a triangle; the second triangle is even."""
    faces = mi.Vector3u([0, 3], [1, 4], [2, 5])
    values = mi.Float(0, 1, 3, 8, 8, 8)
    assert value(losses.edge_smoothness(values, faces)) == pytest.approx((1 + 2 + 3) / 3 / 2)
    colors = mi.Color3f(values, 0, 0)
    assert value(losses.edge_smoothness(colors, faces)) == pytest.approx((1 + 2 + 3) / 3 / 2 / 3)


def test_a_mesh_without_faces_is_smooth():
    faces = mi.Vector3u([], [], [])
    assert value(losses.edge_smoothness(mi.Color3f([], [], []), faces)) == 0
    assert value(losses.normal_variation(mi.Vector3f([], [], []), faces)) == 0


def test_normal_variation():
    """Normals of a fold of 90 degrees: difference sqrt 2 along two of three edges; none on a plane."""
    faces = mi.Vector3u([0], [1], [2])
    fold = mi.Vector3f([1, 0, 0], [0, 1, 1], [0, 0, 0])
    assert value(losses.normal_variation(fold, faces)) == pytest.approx(2 * ((2 + 1e-4) ** 0.5 - 1e-2) / 3)
    assert value(losses.normal_variation(mi.Vector3f([0] * 3, [0] * 3, [1] * 3), faces)) == 0


def test_normal_variation_falls_with_the_edges():
    """Between neighbours on a sphere normals differ by edge length / radius."""

    def of_sphere(subdivisions):
        ball = trimesh.creation.icosphere(subdivisions=subdivisions)
        normals = mi.Vector3f(np.ascontiguousarray(ball.vertices.T, np.float32))
        faces = mi.Vector3u(np.array(ball.faces.T, np.uint32, order="C"))
        found = value(losses.normal_variation(normals, faces))
        # What is much less than a hundredth counts with its square.
        return found / (np.sqrt(ball.edges_unique_length**2 + 1e-4) - 1e-2).mean()

    assert of_sphere(2) == pytest.approx(1, rel=1e-3)
    assert of_sphere(4) == pytest.approx(1, rel=1e-3)


def test_normal_variation_flattens_bumps_and_leaves_a_crease():
    """A crease costs what it turns by, whether at once or in steps; bumps cost more the more there are."""
    faces = mi.Vector3u([0, 1], [1, 2], [1, 2])

    def of(angles):
        return value(losses.normal_variation(mi.Vector3f(np.sin(angles), np.zeros(3), np.cos(angles)), faces))

    assert of([0.0, 0.4, 0.4]) == pytest.approx(of([0.0, 0.2, 0.4]), rel=0.05)
    assert of([0.0, 0.2, 0.0]) > 10 * of([0.0, 0.0, 0.0])
