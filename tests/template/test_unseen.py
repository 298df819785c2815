"""What no view sees is opened."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from topology import boundary_edges

from gshell_mi.fields import sphere
from gshell_mi.lattice import TetLattice
from gshell_mi.template.unseen import without_unseen
from gshell_mi.topology import topology
from gshell_mi.views import PinholeViews

LATTICE, RADIUS, DISTANCE, ELEVATION = TetLattice(32), 0.6, 4.0, np.radians(20)


def views(elevation: float, count: int = 12) -> PinholeViews:
    sensors = []
    for azimuth in 2 * np.pi * np.arange(count) / count:
        around = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
        origin = DISTANCE * np.array([*around, np.sin(elevation)])
        sensors.append(
            mi.load_dict(
                {
                    "type": "perspective",
                    "fov": 30,
                    "to_world": mi.ScalarTransform4f().look_at(origin.tolist(), [0, 0, 0], [0, 0, 1]),
                }
            )
        )
    return PinholeViews.from_sensors(sensors)


@pytest.fixture
def subject():
    return mi.load_dict({"type": "gshell", "resolution": LATTICE.resolution})


def test_the_underside_of_a_ball_seen_from_above(subject):
    """Its rim is where the cameras see the surface at a cosine of 0.2."""
    ball = sphere(LATTICE, RADIUS)
    msdf = without_unseen(subject, ball, views(ELEVATION), 0.02)
    subject.set_fields(type(ball)(ball.sdf, msdf.numpy(), ball.deform))
    vertices, faces, _ = subject.surface.to_numpy()
    found = topology(vertices, faces)
    assert (found.boundary_loops, found.components, found.pinholes) == (1, 1, 0)
    rim = vertices[np.unique(boundary_edges(faces))]
    # In the triangle of center, point and camera, the angle at the point is 90 degrees + that of the view.
    at_camera = np.arcsin(RADIUS / DISTANCE * np.sqrt(1 - 0.2**2))
    horizon = RADIUS * np.sin(ELEVATION - (np.arccos(0.2) - at_camera))
    assert np.abs(rim[:, 2] - horizon).max() < 1.5 * LATTICE.spacing
    assert vertices[:, 2].max() > 0.99 * RADIUS


def test_a_small_part_that_is_seen_stays(subject):
    """A ball of 1.5 % of the area, over the other one: its own piece, and smaller than what is opened."""
    ball = sphere(LATTICE, RADIUS)
    above = np.linalg.norm(LATTICE.vertex_positions() - [0, 0, 0.8], axis=1) - 0.075
    both = replace(ball, sdf=np.minimum(ball.sdf, above.astype(np.float32)))
    msdf = without_unseen(subject, both, views(ELEVATION), 0.02)
    subject.set_fields(replace(both, msdf=msdf.numpy()))
    vertices, faces, _ = subject.surface.to_numpy()
    assert topology(vertices, faces).components == 2
    assert vertices[:, 2].max() > 0.85 and vertices[:, 2].min() > -0.5


@pytest.mark.parametrize(("elevation", "min_area"), [(0.0, 0.05), (ELEVATION, 0.5)])
def test_little_that_is_unseen_stays(subject, elevation, min_area):
    """From the equator two polar caps are hidden or only grazed, of 3.0 % of the area each."""
    assert without_unseen(subject, sphere(LATTICE, RADIUS), views(elevation), min_area) is None
