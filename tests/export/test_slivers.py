"""Narrow triangles are widened, so that stock renderers can interpolate over them."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.export.slivers import without_slivers

#: A fan around the last vertex, which nearly touches the edge from the first to the second.
FACES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
NORMALS = np.tile([0.0, 0, 1], (5, 1))


def fan(height: float) -> np.ndarray:
    return np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.97, height, 0]])


def flatness(vertices: np.ndarray) -> np.ndarray:
    """Height over longest edge of each triangle."""
    corners = vertices[FACES]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all(), "no triangle is turned over"
    return normals[:, 2] / longest**2


@pytest.mark.parametrize("height", [1e-5, 0.0, -1e-5])
def test_narrow_triangles_are_widened(height):
    """Also those without area, and those that lie turned over beneath the next."""
    moved = without_slivers(fan(height), FACES, NORMALS)
    np.testing.assert_array_equal(moved[:4], fan(height)[:4])
    assert 2e-3 <= flatness(moved).min() < 2.5e-3
    assert moved[4, 0] == pytest.approx(0.97) and moved[4, 2] == 0


def test_what_is_wide_enough_stays():
    np.testing.assert_array_equal(without_slivers(fan(0.01), FACES, NORMALS), fan(0.01))


def interpolated(vertices: np.ndarray, x: np.ndarray) -> np.ndarray:
    """What stock Mitsuba makes of the attribute x in the first triangle."""
    mesh = mi.Mesh("fan", len(vertices), 1)
    mesh.add_attribute("vertex_value", 1, vertices[:, 0].astype(np.float32))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(vertices.astype(np.float32).ravel())
    parameters["faces"] = mi.UInt32(FACES[0].astype(np.uint32))
    parameters.update()
    si = dr.zeros(mi.SurfaceInteraction3f, len(x))
    si.p = mi.Point3f(np.stack([x, 0.3 * vertices[4, 1] * x, 0 * x]).astype(np.float32))
    si.shape, si.prim_index = mi.ShapePtr(mesh), dr.zeros(mi.UInt32, len(x))
    return mesh.eval_attribute_1("vertex_value", si).numpy()


def test_stock_mitsuba_interpolates_over_what_is_written():
    x = np.linspace(0.1, 0.9, 100)
    off = [
        np.abs(interpolated(vertices, x) - x).max()
        for vertices in (fan(1e-5), without_slivers(fan(1e-5), FACES, NORMALS))
    ]
    assert not off[0] < 0.1 and off[1] < 0.03
