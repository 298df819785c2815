"""Diagnostics of surfaces whose faults are known."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from fitted import open_sphere

from gshell_mi.diagnostics import diagnose
from gshell_mi.views import PinholeViews

CELL = 0.1


def views(*origins) -> PinholeViews:
    look = [mi.ScalarTransform4f().look_at(list(origin), [0, 0, 0], [0, 1, 0.1]) for origin in origins]
    return PinholeViews.from_sensors(
        [mi.load_dict({"type": "perspective", "fov": 60, "to_world": to_world}) for to_world in look]
    )


AROUND = [(4, 0, 0), (-4, 0, 0), (0, 4, 0), (0, -4, 0), (0, 0, 4), (0, 0, -4)]


def arrays(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_a_sound_surface_has_no_warnings():
    ball = arrays(trimesh.creation.icosphere(3))
    found = diagnose(ball, ball, views(*AROUND), CELL)
    assert (found.pieces, found.floaters, found.boundary_loops, found.pinholes) == (1, 0, 0, 0)
    assert found.self_contact == 0 and found.unobserved < 0.01
    assert found.warnings() == []


def test_an_open_surface_is_seen_from_both_sides():
    bowl = open_sphere()
    surface = (bowl.vertices, bowl.faces)
    ball = arrays(trimesh.creation.icosphere(4, radius=0.6))
    found = diagnose(surface, ball, views((0, 4, 0)), CELL)
    assert found.boundary_loops == 1
    assert found.unobserved < 0.45, "the outside is hidden but for the rim's surroundings; the inside counts"
    below = diagnose(surface, ball, views((0, -4, 0)), CELL)
    assert below.unobserved > found.unobserved


def test_floaters_and_pieces():
    large, other = trimesh.creation.icosphere(3), trimesh.creation.icosphere(2, radius=0.8)
    specks = [trimesh.creation.icosphere(1, radius=0.05).apply_translation([0, 1.5, x]) for x in (0, 0.5)]
    mesh = arrays(trimesh.util.concatenate([large, other.apply_translation([2.5, 0, 0]), *specks]))
    found = diagnose(mesh, mesh, views(*AROUND), CELL)
    assert (found.pieces, found.floaters) == (2, 2)
    assert sum("in 2 pieces" in line for line in found.warnings()) == 1
    assert sum("2 loose pieces" in line for line in found.warnings()) == 1


def test_pinholes():
    ball = trimesh.creation.icosphere(5)
    torn = trimesh.Trimesh(ball.vertices, np.delete(ball.faces, [10, 2000], axis=0), process=False)
    found = diagnose(arrays(torn), arrays(ball), views(*AROUND), CELL)
    assert (found.boundary_loops, found.pinholes) == (0, 2)
    assert len(found.warnings()) == 1 and "2 pin-holes" in found.warnings()[0]


@pytest.mark.parametrize(("distance", "touching"), [(0.5, 0.0), (1.5, 0.0)])
def test_two_plates_apart(distance, touching):
    """Plates 2 x 2, a distance in cells apart and as thick."""
    assert _plates(gap=1.5 + distance, thickness=1.5 + distance) == pytest.approx(touching, abs=0.02)


def test_two_plates_in_contact():
    """One of the two large sides of each plate faces the other; rims are 1 / 20 of the area."""
    assert _plates(gap=0.5, thickness=2) == pytest.approx(8 / (16 + 4 * 4 * 0.2), abs=0.02)


def test_a_plate_thinner_than_a_cell():
    assert _plates(gap=5, thickness=0.5) == pytest.approx(16 / (16 + 4 * 4 * 0.05), abs=0.02)


def _plates(gap: float, thickness: float) -> float:
    size = (2, 2, thickness * CELL)
    upper, lower = (trimesh.creation.box(size) for _ in range(2))
    upper.apply_translation([0, 0, (gap + thickness) * CELL])
    for _ in range(4):
        upper, lower = upper.subdivide(), lower.subdivide()
    mesh = arrays(trimesh.util.concatenate([upper, lower]))
    found = diagnose(mesh, mesh, views(*AROUND), CELL)
    assert any("within a cell" in line for line in found.warnings()) == (found.self_contact > 0.05)
    return found.self_contact


def test_unobserved_area():
    """One view from far above sees the upper half of a sphere; the lower half is around (0, -1/2, 0)."""
    ball = arrays(trimesh.creation.icosphere(4))
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": 3,
            "far_clip": 1e4,
            "to_world": mi.ScalarTransform4f().look_at([0, 100, 0], [0, 0, 0], [0, 0, 1]),
        }
    )
    found = diagnose(ball, ball, PinholeViews.from_sensors([sensor]), CELL)
    assert found.unobserved == pytest.approx(0.5, abs=0.06)
    np.testing.assert_allclose(found.unobserved_center, [0, -0.5, 0], atol=0.06)
    assert any("seen by no view" in line and "-0.5" in line for line in found.warnings())


def test_views_that_look_elsewhere():
    ball = arrays(trimesh.creation.icosphere(2))
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": 20,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 10], [0, 1, 0]),
        }
    )
    assert diagnose(ball, ball, PinholeViews.from_sensors([sensor]), CELL).unobserved == pytest.approx(1)


def test_nothing_left():
    nothing = (np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    found = diagnose(nothing, nothing, views(*AROUND), CELL)
    assert found.pieces == 0 and "no surface is left" in found.warnings()[0]
