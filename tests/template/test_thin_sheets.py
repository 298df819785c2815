"""Where both sides of a sheet are surface one goes: beside openings, and of what is nothing but a sheet."""

import mitsuba as mi
import numpy as np
import pytest

from gshell_mi import TetLattice, extract
from gshell_mi.fields import LatticeFields
from gshell_mi.template.revoxelise import revoxelise
from gshell_mi.template.sides import opposite_sides
from gshell_mi.template.thin_sheets import Cut, collapsed_sheets
from gshell_mi.topology import topology
from gshell_mi.triangles import positive_part

RESOLUTION = 32
CELL = 2 / RESOLUTION
HEIGHT, RADIUS = 0.3 * CELL, 0.6


def template(sdf: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    lattice = TetLattice(RESOLUTION)
    fields = LatticeFields.closed(sdf)
    mesh = extract(lattice, *(mi.Float(a) for a in (fields.sdf, fields.msdf, fields.deform)), template=True)
    vertices, faces, _ = mesh.template.to_numpy()
    return vertices.astype(float), faces


def plate() -> tuple[np.ndarray, np.ndarray]:
    """A round plate of 1.6 cells, as a hull is grown to."""
    points = TetLattice(RESOLUTION).vertex_positions()
    return template(
        np.maximum(np.abs(points[:, 2] - HEIGHT) - 0.8 * CELL, np.hypot(points[:, 0], points[:, 1]) - RADIUS)
    )


def flattened(vertices: np.ndarray, thickness: float) -> np.ndarray:
    """The plate with its sides ``thickness`` cells apart, and a little noise."""
    scale = thickness / 1.6
    noise = np.random.default_rng(0).normal(0, 0.05 * CELL, len(vertices))
    moved = vertices.copy()
    moved[:, 2] = HEIGHT + scale * (vertices[:, 2] - HEIGHT) + noise
    return moved


def cut(vertices: np.ndarray, moved: np.ndarray, faces: np.ndarray, solid: np.ndarray) -> Cut | None:
    found = topology(vertices, faces[solid[faces].all(axis=1)])
    return collapsed_sheets(
        Cut(np.where(solid, 3.0, -3.0), moved, found, found.boundary_loops), vertices, faces, CELL, 0.5, 0.005
    )


@pytest.mark.parametrize("thickness", [0.2, -0.2])
def test_of_a_sheet_one_side_is_left(thickness):
    vertices, faces = plate()
    found = cut(vertices, flattened(vertices, thickness), faces, np.full(len(vertices), True))
    within = np.hypot(vertices[:, 0], vertices[:, 1]) < RADIUS - 2 * CELL
    upper = vertices[:, 2] > HEIGHT
    opened = found.logits < 0
    assert opened[within & upper].all() != opened[within & ~upper].all()
    assert opened[within & upper].any() != opened[within & ~upper].any()
    assert found.topology.boundary_loops == 1

    subject = mi.load_dict({"type": "gshell", "resolution": RESOLUTION})
    made = revoxelise(
        subject,
        subject.lattice,
        vertices,
        found.positions,
        faces,
        found.logits,
        np.ones((len(vertices), 3)),
        0.005,
        found.topology,
        found.fewest_loops,
    )
    assert made is not None and made.has_loops
    closed = LatticeFields.closed(made.fields["sdf"])
    subject.set_fields(LatticeFields(closed.sdf, made.fields["msdf"], closed.deform))
    surface, surface_faces, _ = subject.surface.to_numpy()
    after = topology(surface, surface_faces)
    assert (after.boundary_loops, after.pinholes, after.components) == (1, 0, 1)
    inner = np.hypot(surface[:, 0], surface[:, 1]) < RADIUS - 3 * CELL
    np.testing.assert_allclose(surface[inner, 2], HEIGHT, atol=0.35 * CELL)
    area = 0.5 * np.linalg.norm(
        np.cross(
            surface[surface_faces[:, 1]] - surface[surface_faces[:, 0]],
            surface[surface_faces[:, 2]] - surface[surface_faces[:, 0]],
        ),
        axis=1,
    )
    assert area.sum() == pytest.approx(np.pi * RADIUS**2, rel=0.2)


def test_a_plate_keeps_both_sides():
    vertices, faces = plate()
    assert cut(vertices, flattened(vertices, 0.9), faces, np.full(len(vertices), True)) is None


def test_a_ball_and_its_fin_keep_theirs():
    points = TetLattice(RESOLUTION).vertex_positions()
    radius = np.hypot(points[:, 0], points[:, 1])
    fin = np.maximum(np.abs(points[:, 2] - HEIGHT) - 0.8 * CELL, np.abs(radius - 0.4) - 0.3)
    ball = np.linalg.norm(points, axis=1) - 0.5
    vertices, faces = template(np.minimum(ball, fin))
    beyond = np.hypot(vertices[:, 0], vertices[:, 1]) > 0.55
    moved = np.where(beyond[:, None], flattened(vertices, 0.2), vertices)
    assert cut(vertices, moved, faces, np.full(len(vertices), True)) is None


def test_an_opening_grows_over_the_side_that_it_is_in():
    vertices, faces = plate()
    radius, upper = np.hypot(vertices[:, 0], vertices[:, 1]), vertices[:, 2] > HEIGHT
    solid = upper | (radius > 0.3)
    found = cut(vertices, flattened(vertices, 0.2), faces, solid)
    opened = found.logits < 0
    within = radius < RADIUS - 2 * CELL
    assert opened[within & ~upper].all() and not opened[within & upper].any()
    assert found.topology.boundary_loops == 1


def test_spare_sides_follow_those_that_stay():
    vertices, faces = plate()
    moved = flattened(vertices, 0.2) + np.array([0, 0, CELL])
    found = cut(vertices, moved, faces, np.full(len(vertices), True))
    thickness, _ = opposite_sides(found.positions, found.positions, faces, CELL)
    within = np.hypot(vertices[:, 0], vertices[:, 1]) < RADIUS - 2 * CELL
    np.testing.assert_allclose(thickness[within], 1.6 * CELL, atol=0.5 * CELL)


def test_holes_through_a_sheet_keep_narrow_bridges_between_them():
    """A plate with two holes, three cells apart: with one side gone it has three rims, and is whole."""
    points = TetLattice(RESOLUTION).vertex_positions()
    radius = np.hypot(points[:, 0], points[:, 1])
    holes = [np.hypot(points[:, 0] - side, points[:, 1]) - 0.2 for side in (-0.29, 0.29)]
    solid = np.maximum(np.abs(points[:, 2] - HEIGHT) - 0.8 * CELL, radius - RADIUS)
    vertices, faces = template(np.maximum(solid, -np.minimum(*holes)))
    found = cut(vertices, flattened(vertices, 0.2), faces, np.full(len(vertices), True))
    assert (found.topology.boundary_loops, found.topology.components) == (3, 1)
    assert found.fewest_loops == 1
    left, left_faces = positive_part(vertices, faces, found.logits)
    between = (np.abs(left[:, 0]) < 0.5 * CELL) & (np.abs(left[:, 1]) < 0.5 * CELL)
    assert np.isin(np.flatnonzero(between), left_faces).any(), "the bridge is there"


def test_the_largest_opening_grows_first():
    """A small opening in the other side takes nothing of it, though it reaches it at once."""
    vertices, faces = plate()
    radius, upper = np.hypot(vertices[:, 0], vertices[:, 1]), vertices[:, 2] > HEIGHT
    from_small = np.hypot(vertices[:, 0] - 0.35, vertices[:, 1])
    solid = np.where(upper, from_small > 2 * CELL, np.hypot(vertices[:, 0] + 0.2, vertices[:, 1]) > 0.3)
    found = cut(vertices, flattened(vertices, 0.2), faces, solid)
    opened = found.logits < 0
    within = (radius < RADIUS - 2 * CELL) & (from_small > 4 * CELL)
    assert opened[within & ~upper].all() and not opened[within & upper].any()


def test_an_island_of_a_few_cells_is_a_sheet_too():
    """Beside a large plate that is open below, a small one, not round, whose edge is most of it."""
    points = TetLattice(RESOLUTION).vertex_positions()
    radius = np.hypot(points[:, 0] + 0.2, points[:, 1])
    large = radius - 0.5
    small = np.hypot(points[:, 0] - 0.6, 0.6 * points[:, 1]) - 1.6 * CELL
    sheet = np.minimum(large, small)
    vertices, faces = template(np.maximum(np.abs(points[:, 2] - HEIGHT) - 0.8 * CELL, sheet))
    radius, upper = np.hypot(vertices[:, 0] + 0.2, vertices[:, 1]), vertices[:, 2] > HEIGHT
    found = cut(vertices, flattened(vertices, 0.2), faces, upper | (radius > 0.2))
    assert (found.topology.boundary_loops, found.topology.components) == (2, 2)
    island = vertices[:, 0] > 0.4
    opened = [(found.logits < 0)[island & side].mean() for side in (upper, ~upper)]
    assert max(opened) > 0.9 and min(opened) < 0.2
