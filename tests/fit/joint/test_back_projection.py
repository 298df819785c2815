"""Colours finer than the lattice are found from renders of a textured plate."""

import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.fit.joint.back_projection import BackProjection, FineMesh
from gshell_mi.subdivision import subdivided
from gshell_mi.targets import Target
from gshell_mi.views import PinholeViews

SIZE, LIGHT = 48, {"light": {"type": "constant", "radiance": 0.8}}


def _plate(color) -> FineMesh:
    """A square of 32 x 32 cells facing +z; ``color`` maps (V, 2) positions to (V, 3)."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    vertices, faces, _ = subdivided(corners, np.array([[0, 1, 2], [0, 2, 3]]), {}, 5)
    normals = np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
    ones = np.ones(len(vertices))
    return FineMesh(vertices, faces, normals, color(vertices[:, :2]), ones, 0 * ones)


def _checks(at: np.ndarray) -> np.ndarray:
    bright = (np.floor(4 * at[:, :1]) + np.floor(4 * at[:, 1:])) % 2
    return np.where(bright > 0, [0.8, 0.6, 0.5], [0.2, 0.2, 0.4])


def _grey(at: np.ndarray) -> np.ndarray:
    return np.full((len(at), 3), 0.4)


@pytest.fixture(scope="module")
def capture():
    film = {
        "type": "hdrfilm",
        "width": SIZE,
        "height": SIZE,
        "rfilter": {"type": "box"},
        "pixel_format": "rgba",
    }
    look_at = mi.ScalarTransform4f().look_at
    sensors = [
        mi.load_dict(
            {
                "type": "perspective",
                "fov": 40,
                "film": film,
                "to_world": look_at([x, y, 3], [0, 0, 0], [0, 1, 0]),
            }
        )
        for x in (-1, 0, 1)
        for y in (-1, 0, 1)
    ]
    scene = mi.load_dict(
        {
            "type": "scene",
            "subject": _plate(_checks).shape(),
            **LIGHT,
            "integrator": {"type": "path", "max_depth": 5, "hide_emitters": True},
        }
    )
    targets = [Target(None, np.array(mi.render(scene, sensor=sensor, spp=64)), True) for sensor in sensors]
    return sensors, PinholeViews.from_sensors(sensors), targets


def _work(capture, mesh, kept, objects=LIGHT) -> BackProjection:
    sensors, views, targets = capture
    return BackProjection(mesh, objects, sensors, views, targets, [], kept)


def test_checks_are_found(capture):
    work = _work(capture, _plate(_grey), {})
    for step in range(2 * len(capture[0])):
        work.step(step)
    truth = _plate(_checks)
    # Apart from the checks' edges, where pixels see both, and from that of the plate.
    at = 4 * truth.vertices[:, :2]
    inner = (np.abs(at - np.round(at)).min(axis=1) > 0.2) & (np.abs(at).max(axis=1) < 3.7)
    assert np.abs(work.colors() - truth.color)[inner].mean() < 0.05
    assert np.abs(_grey(at) - truth.color)[inner].mean() > 0.15


def test_what_agrees_stays(capture):
    mesh = _plate(_checks)
    work = _work(capture, mesh, {})
    for step in range(2 * len(capture[0])):
        work.step(step)
    assert np.abs(work.colors() - mesh.color).mean() < 0.03


def test_it_goes_on_where_it_was(capture):
    steps, whole = len(capture[0]) + 3, _work(capture, _plate(_grey), {})
    for step in range(steps - 2):
        whole.step(step)
    begun = _work(capture, _plate(_grey), whole.state())
    for step in range(steps - 2, steps):
        whole.step(step)
        begun.step(step)
    for name, values in whole.state().items():
        np.testing.assert_allclose(begun.state()[name], values, rtol=1e-4, atol=1e-4)


def test_what_stands_before_the_object_tells_nothing_of_it(capture):
    """A card before the camera in the middle: its triangles are not the object's first ones."""
    transform = mi.ScalarTransform4f().translate([0, 0, 2.5]).scale(0.05)
    card = {"card": {"type": "rectangle", "to_world": transform}}

    def told(objects: dict) -> np.ndarray:
        """Of each vertex, how much images of a part of a round say of it."""
        work = _work(capture, _plate(_grey), {}, objects)
        for step in range(len(capture[0]) - 1):
            work.step(step)
        return work.state()["images"].reshape(-1, 3)[:, 0]

    hidden, seen = told(LIGHT | card), told(LIGHT)
    assert (hidden <= seen + 1e-3).all(), "no vertex hears of more pixels"
    assert hidden.sum() < 0.99 * seen.sum()
