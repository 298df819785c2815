"""Cutting a template open: which cuts are kept, and where the rim comes to lie."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cap import cap
from topology import assert_manifold, loop_count

from gshell_mi.extraction import extract
from gshell_mi.fields import sphere
from gshell_mi.lattice import TetLattice
from gshell_mi.template.msdf import clean_opacity, msdf_from_template, splat_to_lattice, without_specks


def test_small_cuts_and_islands_are_undone(ball):
    big, small = cap(ball, [0, 0, 1], 0.2), cap(ball, [1, 0, 0], 0.004)
    island = cap(ball, [0, 0, 1], 0.004)
    logits = np.where((big & ~island) | small, -2.0, 3.0)
    before = logits.copy()
    cleaned = clean_opacity(logits, ball.vertices, ball.faces, min_area=0.02)
    np.testing.assert_array_equal(cleaned <= 0, big)
    np.testing.assert_array_equal(np.abs(cleaned), np.abs(before))
    np.testing.assert_array_equal(logits, before)


def test_large_patches_stay(ball):
    logits = np.where(cap(ball, [0, 0, 1], 0.05) | cap(ball, [0, -1, 0], 0.1), -1.0, 1.0)
    np.testing.assert_array_equal(clean_opacity(logits, ball.vertices, ball.faces, min_area=0.02), logits)


def test_islands_are_measured_by_the_surface(ball):
    """Of a sheet half of the template is open; an island of it has but one side."""
    island = cap(ball, [0, 0, 1], 0.013)
    logits = np.where(cap(ball, [0, 0, 1], 0.5) & ~island, -1.0, 1.0)
    np.testing.assert_array_equal(clean_opacity(logits, ball.vertices, ball.faces, min_area=0.02), logits)
    assert (clean_opacity(logits, ball.vertices, ball.faces, min_area=0.03)[island] < 0).all()


def test_an_island_in_a_small_cut_is_just_surface(ball):
    logits = np.where(cap(ball, [0, 0, 1], 0.015) & ~cap(ball, [0, 0, 1], 0.004), -1.0, 1.0)
    assert (clean_opacity(logits, ball.vertices, ball.faces, min_area=0.02) > 0).all()


def test_a_side_of_a_small_piece_is_no_speck(ball):
    """A ball beside the large one, with 3 % of the area, of which one half is open; one with 0.3 % goes."""
    pieces = [(1.0, [0, 0, 0]), (0.175, [2, 0, 0]), (0.055, [0, 2, 0])]
    vertices = np.concatenate([scale * ball.vertices + offset for scale, offset in pieces])
    count = len(ball.vertices)
    faces = np.concatenate([ball.faces + piece * count for piece in range(len(pieces))])
    logits = np.ones(len(vertices))
    logits[count:][cap(ball, [0, 0, 1], 0.6)[np.arange(2 * count) % count]] = -1
    cleaned = clean_opacity(logits, vertices, faces, min_area=0.02)
    np.testing.assert_array_equal(cleaned[: 2 * count], logits[: 2 * count])
    assert (cleaned[2 * count :] < 0).all()


@pytest.mark.parametrize("height", [-0.21, 0.0, 0.337])
def test_the_rim_lies_where_the_logits_change_sign(height):
    lattice = TetLattice(24)
    fields = sphere(lattice, 0.7)
    sdf, closed, still = (mi.Float(a) for a in (fields.sdf, fields.msdf, fields.deform))
    template = extract(lattice, sdf, closed, still, template=True).template
    vertices, _, _ = template.to_numpy()
    logits = (height - vertices[:, 1]) / lattice.spacing
    surface = extract(lattice, sdf, msdf_from_template(logits, template, lattice), still)
    vertices, faces, msdf = surface.to_numpy()
    assert_manifold(vertices, faces)
    assert loop_count(faces) == 1
    error = (vertices[msdf == 0, 1] - height) / lattice.spacing
    assert len(error) > 40 and np.abs(error).max() < 0.25 and np.abs(error.mean()) < 0.05
    assert vertices[:, 1].max() < height + 0.25 * lattice.spacing and vertices[:, 1].min() < -0.69


def test_all_solid_stays_closed():
    lattice = TetLattice(12)
    fields = sphere(lattice)
    sdf, closed, still = (mi.Float(a) for a in (fields.sdf, fields.msdf, fields.deform))
    template = extract(lattice, sdf, closed, still, template=True).template
    msdf = msdf_from_template(np.full(template.vertex_count, 8.0), template, lattice)
    _, faces, _ = extract(lattice, sdf, msdf, still).to_numpy()
    assert loop_count(faces) == 0 and len(faces) == template.face_count
    assert msdf.numpy().max() <= 3 * lattice.spacing * 1.001, "certainty is limited"


def test_splatted_constants_come_back():
    lattice = TetLattice(12)
    fields = sphere(lattice)
    mesh = extract(lattice, *(mi.Float(a) for a in (fields.sdf, fields.msdf, fields.deform)), template=True)
    template = mesh.template
    colors = mi.Float(np.tile([0.2, 0.5, 0.9], template.vertex_count).astype(np.float32))
    field, known = splat_to_lattice(colors, template, lattice)
    assert known.numpy()[np.abs(fields.sdf) < 2 * lattice.spacing].all()
    back = template.interpolate(field, 3).numpy()
    np.testing.assert_allclose(back.T, np.tile([0.2, 0.5, 0.9], (template.vertex_count, 1)), rtol=1e-4)


def test_specks_go_and_openings_stay():
    lattice = TetLattice(24)
    fields = sphere(lattice, 0.7)
    sdf, still = mi.Float(fields.sdf), mi.Float(fields.deform)
    points = lattice.vertex_positions()
    opening = 0.3 - points[:, 1]
    cut = 0.12 - np.linalg.norm(points - [0.7, -0.2, 0], axis=1)
    island = 0.12 - np.linalg.norm(points - [0, 0.7, 0], axis=1)
    msdf = mi.Float(np.maximum(np.minimum(opening, -cut), island).astype(np.float32))
    template = extract(lattice, sdf, msdf, still, template=True).template
    assert loop_count(extract(lattice, sdf, msdf, still).to_numpy()[1]) == 3
    cleaned = without_specks(msdf, template, lattice, 0.02)
    vertices, faces, _ = extract(lattice, sdf, cleaned, still).to_numpy()
    assert loop_count(faces) == 1
    assert vertices[:, 1].max() == pytest.approx(0.3, abs=1e-4)
    far = (np.abs(cut) > 0.3) & (np.abs(island) > 0.3)
    np.testing.assert_array_equal(cleaned.numpy()[far], msdf.numpy()[far])


def test_a_speck_in_a_thin_part_goes_and_leaves_the_other_side_open():
    """Both sides of a plate of 1.2 cells share the lattice vertices between them."""
    lattice = TetLattice(24)
    points, cell = lattice.vertex_positions(), lattice.spacing
    sdf = np.maximum(np.abs(points[:, 2]) - 0.6 * cell, np.hypot(points[:, 0], points[:, 1]) - 0.7)
    sdf, still = mi.Float(sdf.astype(np.float32)), mi.Float(np.zeros(points.size, np.float32))
    solid = dr.full(mi.Float, 1, lattice.vertex_count)
    template = extract(lattice, sdf, solid, still, template=True).template
    vertices = template.to_numpy()[0]
    upper = vertices[:, 2] > 0
    specks = (
        np.linalg.norm(vertices[:, None] - [[0.1, 0.1, 0.6 * cell], [-0.3, 0.2, 0.6 * cell]], axis=2).min(
            axis=1
        )
        < 0.8 * cell
    )
    msdf = msdf_from_template(np.where(upper & ~specks, 1.0, -1.0), template, lattice)
    assert loop_count(extract(lattice, sdf, msdf, still).to_numpy()[1]) > 1
    cleaned = without_specks(msdf, template, lattice, 0.02)
    assert loop_count(extract(lattice, sdf, cleaned, still).to_numpy()[1]) == 1
    found = template.interpolate(cleaned).numpy() > 0
    within = np.hypot(vertices[:, 0], vertices[:, 1]) < 0.7 - 2 * cell
    assert found[within & upper].all() and not found[within & ~upper].any()
