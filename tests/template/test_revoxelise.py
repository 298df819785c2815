"""Fields of moved templates: the surface lies where it was moved to, in one piece, with its openings."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from gshell_mi.fields import LatticeFields
from gshell_mi.template.revoxelise import Revoxelised, is_torn, revoxelise, thickened
from gshell_mi.topology import Topology, topology
from gshell_mi.triangles import positive_part

RESOLUTION = 32
CELL = 2 / RESOLUTION


def sphere(to_world: mi.ScalarTransform4f | None = None):
    """A gshell shape of radius 0.6 in lattice units, its template's vertices and faces."""
    subject = mi.load_dict(
        {"type": "gshell", "resolution": RESOLUTION, "to_world": to_world or mi.ScalarTransform4f()}
    )
    radius = np.linalg.norm(subject.lattice.vertex_positions(), axis=1)
    subject.set_fields(LatticeFields.closed(radius - 0.6))
    vertices, faces, _ = subject.template().to_numpy()
    return subject, vertices.astype(float), faces


def surface(subject, made: Revoxelised | None) -> trimesh.Trimesh:
    assert made is not None
    closed = LatticeFields.closed(made.fields["sdf"])
    subject.set_fields(LatticeFields(closed.sdf, made.fields["msdf"], closed.deform))
    vertices, faces, _ = subject.surface.to_numpy()
    return trimesh.Trimesh(vertices, faces, process=False)


def counts(loops: int) -> Topology:
    return Topology(
        vertices=0,
        faces=0,
        components=1,
        boundary_loops=loops,
        pinholes=0,
        boundary_length=0.0,
        nonmanifold_edges=0,
    )


def revoxelised(subject, vertices, moved, faces, logits, wanted: Topology) -> Revoxelised | None:
    """Of a white template, on the subject's lattice."""
    white = np.ones((len(vertices), 3))
    return revoxelise(subject, subject.lattice, vertices, moved, faces, logits, white, 0.005, wanted)


def solid(vertices) -> np.ndarray:
    return np.full(len(vertices), 8.0)


@pytest.mark.parametrize("mirror", [False, True])
def test_a_sphere_that_grew(mirror):
    scale = [-2, 2, 2] if mirror else [2, 2, 2]
    subject, vertices, faces = sphere(mi.ScalarTransform4f().translate([5, 0, 0]).scale(scale))
    centre = np.array([5.0, 0, 0])
    moved = centre + 1.2 * (vertices - centre)
    made = revoxelise(
        subject,
        subject.lattice,
        vertices,
        moved,
        faces,
        solid(vertices),
        np.abs(vertices - centre),
        0.005,
        counts(0),
    )
    found = surface(subject, made)
    radius = np.linalg.norm(found.vertices - centre, axis=1)
    np.testing.assert_allclose(radius, 1.44, atol=0.08 * 2 * CELL)
    assert found.is_watertight and found.volume > 0
    assert made.has_loops
    known = made.fields["known"]
    # Each takes its radiance along from where it was.
    expected = np.abs(subject.lattice.vertex_positions()[known] * scale / 1.2)
    near = np.abs(made.fields["sdf"][known]) < 0.5 * CELL
    np.testing.assert_allclose(made.fields["radiance"][known][near], expected[near], atol=2 * CELL)


def test_the_opening_moves_along():
    subject, vertices, faces = sphere()
    logits = (0.2 - vertices[:, 1]) / CELL
    made = revoxelised(subject, vertices, vertices * [1, 1.25, 1], faces, logits, counts(1))
    found = surface(subject, made)
    after = topology(found.vertices, found.faces)
    assert (after.boundary_loops, after.pinholes, after.components) == (1, 0, 1)
    assert found.vertices[:, 1].max() == pytest.approx(0.25, abs=0.2 * CELL)
    assert found.vertices[:, 1].min() == pytest.approx(-0.75, abs=0.1 * CELL)


def test_a_sheet_stays_whole_and_in_its_place():
    """Of a plate as thin as a third of a cell a disc of the upper side is surface."""
    plate = trimesh.creation.box(extents=[1.3, 1.3, CELL / 3])
    for _ in range(6):
        plate = plate.subdivide()
    vertices, faces = np.array(plate.vertices), np.array(plate.faces)
    top = 0.1
    vertices[:, 2] += top - CELL / 6
    logits = np.where(vertices[:, 2] > top - 0.1 * CELL, 0.5 - np.hypot(*vertices[:, :2].T), -1) / CELL
    subject, *_ = sphere()
    made = revoxelised(subject, vertices, vertices, faces, logits, counts(1))
    found = surface(subject, made)
    after = topology(found.vertices, found.faces)
    assert (after.boundary_loops, after.pinholes, after.components) == (1, 0, 1)
    error = np.abs(found.vertices[:, 2] - top) / CELL
    within = np.hypot(found.vertices[:, 0], found.vertices[:, 1]) < 0.4
    assert error[within].max() < 1e-3 and error.max() < 0.25
    assert after.boundary_length == pytest.approx(np.pi, rel=0.05)


def test_a_collapse_goes_only_as_far_as_the_surface_lasts():
    subject, vertices, faces = sphere()
    made = revoxelised(subject, vertices, np.zeros_like(vertices), faces, solid(vertices), counts(0))
    radius = np.linalg.norm(surface(subject, made).vertices, axis=1)
    np.testing.assert_allclose(radius, 0.3 * 0.6, atol=0.1 * CELL)


def test_a_loop_that_closes_however_little_moves_costs_nothing_of_the_movement():
    """A round opening at the top of a ball that grows is drawn together, to less than any cut may measure."""
    subject, vertices, faces = sphere()
    beside = np.hypot(*vertices[:, :2].T)
    logits = np.where(vertices[:, 2] > 0, beside - 0.11, 8) / CELL
    pull = np.where(vertices[:, 2] > 0, 0.9 * np.clip(2 - beside / 0.11, 0, 1), 0)
    moved = 1.1 * np.column_stack([vertices[:, :2] * (1 - pull)[:, None], vertices[:, 2]])
    made = revoxelised(subject, vertices, moved, faces, logits, counts(1))
    found = surface(subject, made)
    assert not made.has_loops and found.is_watertight
    low = found.vertices[found.vertices[:, 2] < 0]
    np.testing.assert_allclose(np.linalg.norm(low, axis=1), 0.66, atol=0.1 * CELL)


def test_only_the_open_side_gives_way():
    plate = trimesh.creation.box(extents=[1, 1, 0.5 * CELL])
    for _ in range(5):
        plate = plate.subdivide()
    vertices, faces = np.array(plate.vertices), np.array(plate.faces)
    upper = vertices[:, 2] > -0.2 * CELL
    moved = thickened(vertices, vertices, faces, upper, CELL)
    middle = (np.abs(vertices[:, :2]) < 0.4).all(axis=1)
    np.testing.assert_array_equal(moved[middle & upper], vertices[middle & upper])
    np.testing.assert_allclose(moved[middle & ~upper, 2], (0.25 - 1.8) * CELL, atol=0.1 * CELL)


def test_sides_that_moved_through_each_other_come_apart():
    plate = trimesh.creation.box(extents=[1, 1, 0.5 * CELL])
    for _ in range(5):
        plate = plate.subdivide()
    vertices, faces = np.array(plate.vertices), np.array(plate.faces)
    upper, middle = vertices[:, 2] > 0, (np.abs(vertices[:, :2]) < 0.4).all(axis=1)
    moved = np.where(middle[:, None], vertices * [1, 1, -1], vertices)
    apart = thickened(vertices, moved, faces, np.full(len(vertices), True), CELL)
    inner = (np.abs(vertices[:, :2]) < 0.25).all(axis=1)
    # Both sides are surface: 0.9 cells apart, and neither has moved more than the other.
    np.testing.assert_allclose(apart[inner & upper, 2], 0.45 * CELL, atol=0.15 * CELL)
    np.testing.assert_allclose(apart[inner & ~upper, 2], -0.45 * CELL, atol=0.15 * CELL)


def test_a_slit_that_closes_becomes_a_bridge():
    """The upper side of a ring with a slit, whose two ends meet: two boundaries instead of one."""
    subject, *_ = sphere()
    inner, outer, half_slit = 0.25, 0.6, 1.2 * CELL
    x, y, z = subject.lattice.vertex_positions().T
    slit = np.where(x > 0, np.abs(y) - half_slit, np.hypot(x, np.abs(y) + half_slit))
    ring = np.minimum(np.minimum(np.hypot(x, y) - inner, outer - np.hypot(x, y)), slit)
    subject.set_fields(LatticeFields.closed(np.maximum(-ring, np.abs(z) - 0.8 * CELL)))
    vertices, faces, _ = subject.template().to_numpy()
    logits = np.where(vertices[:, 2] > 0.5 * CELL, 1.0, -1.0)
    angle, radius = np.arctan2(vertices[:, 1], vertices[:, 0]), np.hypot(*vertices[:, :2].T)
    # The ends' edges come to lie on the positive x axis.
    closed = np.pi - (np.pi - np.abs(angle)) * np.pi / (np.pi - np.arcsin(half_slit / radius))
    moved = vertices.copy()
    moved[:, 0], moved[:, 1] = radius * np.cos(closed), radius * np.sin(closed) * np.sign(angle)
    cut = topology(*positive_part(vertices, faces, logits))
    assert cut.boundary_loops == 1
    made = revoxelised(subject, vertices, moved, faces, logits, cut)
    found = surface(subject, made)
    after = topology(found.vertices, found.faces)
    assert (after.boundary_loops, after.pinholes, after.components) == (2, 0, 1)
    assert after.boundary_length == pytest.approx(2 * np.pi * (inner + outer), rel=0.1)


def test_a_boundary_far_from_all_rims_is_a_tear():
    plate = trimesh.creation.box(extents=[1.3, 1.3, CELL / 3])
    for _ in range(6):
        plate = plate.subdivide()
    vertices, faces = np.array(plate.vertices), np.array(plate.faces)
    radius = np.where(vertices[:, 2] > 0, np.hypot(*vertices[:, :2].T), np.inf)
    disc = positive_part(vertices, faces, 0.6 - radius)
    ring = positive_part(vertices, faces, np.minimum(0.6 - radius, radius - 0.2))
    pricked = positive_part(vertices, faces, np.minimum(0.6 - radius, radius - 0.005))
    smaller = positive_part(vertices, faces, 0.59 - radius)
    assert is_torn(*ring, *disc, near=0.1)
    assert not is_torn(*ring, *ring, near=0.1)
    assert not is_torn(*pricked, *disc, near=0.1)
    assert not is_torn(*smaller, *disc, near=0.1)
    assert not is_torn(vertices, faces, *disc, near=0.1)
    assert is_torn(*disc, vertices, faces, near=0.1)
