"""Caps go on as the surface around them does."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from cap import cap

from gshell_mi.extraction import extract
from gshell_mi.lattice import TetLattice
from gshell_mi.template.caps import Recesses, least_bent, put_in_place
from gshell_mi.topology import topology

RADIUS = 0.6


def test_a_dent_in_a_ball_is_taken_back(ball):
    free = cap(ball, [0, 0, 1], 0.05)
    dented = np.where(free[:, None], 0.8 * ball.vertices, ball.vertices)
    moved = least_bent(dented, ball.faces, free)
    np.testing.assert_array_equal(moved[~free], dented[~free])
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1, atol=0.005)


def test_nothing_is_free(ball):
    none = np.zeros(len(ball.vertices), bool)
    np.testing.assert_array_equal(least_bent(ball.vertices, ball.faces, none), ball.vertices)


def test_without_surroundings_a_cap_stays_finite(ball):
    assert np.isfinite(least_bent(ball.vertices, ball.faces, np.ones(len(ball.vertices), bool))).all()


@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_a_recess_has_a_floor_and_walls(ball, unit):
    """Of two depths at once, where the ball is nearly flat."""
    place = np.where(cap(ball, [0, 0, 1], 0.02), 0, np.where(cap(ball, [1, 0, 0], 0.02), 1, -1))
    recesses = Recesses(unit * ball.vertices, ball.faces, place)
    deep = np.array([0.03, 0.5])
    moved = recesses.at(unit * deep) / unit
    np.testing.assert_allclose(moved[place < 0], ball.vertices[place < 0], atol=1e-12)
    for index, axis in enumerate(np.eye(3)[[2, 0]]):
        at = place == index
        depth = (ball.vertices - moved)[at] @ axis
        assert depth.max() == pytest.approx(deep[index], rel=0.02) and depth.min() > 0
        np.testing.assert_allclose(moved[at] + np.outer(depth, axis), ball.vertices[at], atol=0.02)
        middle = np.linalg.norm(ball.vertices[at] - axis, axis=1) < 0.05
        assert depth[middle].min() == pytest.approx(deep[index], rel=0.1)


def test_a_recess_ends_half_way_to_what_is_behind_it(ball):
    place = np.where(cap(ball, [0, 0, 1], 0.05), 0, -1)
    recesses = Recesses(ball.vertices, ball.faces, place)
    moved = recesses.at(10.0)
    assert moved[place == 0, 2].min() == pytest.approx(0, abs=0.01)
    assert recesses.depths(0.3) == pytest.approx([0.3, 0.6, 1.2])


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_a_bulge_goes(scale):
    """World units are another than the lattice's; the surface elsewhere is the same bit for bit."""
    lattice = TetLattice(32)
    points = lattice.vertex_positions()
    pole = np.array([0, 0, RADIUS])
    bulge = np.linalg.norm(points - pole, axis=1) - 3 * lattice.spacing
    sdf = np.minimum(np.linalg.norm(points, axis=1) - RADIUS, bulge) / lattice.spacing
    vertices, faces, _ = extract(lattice, mi.Float(sdf.astype(np.float32))).to_numpy()
    caps = np.linalg.norm(vertices - pole, axis=1) < 3.5 * lattice.spacing
    moved = least_bent(scale * vertices, faces, caps)
    smooth, told = put_in_place(sdf, scale * points, scale * vertices, moved, faces, scale * lattice.spacing)
    found = extract(lattice, mi.Float(smooth.astype(np.float32))).to_numpy()[0]
    before, after = (np.linalg.norm(at, axis=1).max() - RADIUS for at in (vertices, found))
    assert before > 2.8 * lattice.spacing and after < 0.7 * lattice.spacing
    far = np.linalg.norm(points - pole, axis=1) > 9 * lattice.spacing
    np.testing.assert_array_equal(smooth[far], sdf[far])
    assert not told[far].any() and told[np.linalg.norm(points - pole, axis=1) < lattice.spacing].all()


def test_a_recess_comes_out_as_deep_as_it_is_meant():
    """Its walls are steep: one triangle from top to bottom."""
    lattice = TetLattice(48)
    points, cell = lattice.vertex_positions(), lattice.spacing
    sdf = (np.linalg.norm(points, axis=1) - RADIUS) / cell
    vertices, faces, _ = extract(lattice, mi.Float(sdf.astype(np.float32))).to_numpy()
    place = np.where(vertices[:, 2] > 0.9 * RADIUS, 0, -1)
    deep = 7 * cell
    moved = Recesses(vertices, faces, place).at(deep)
    sunk, _ = put_in_place(sdf, points, vertices, moved, faces, cell)
    found, triangles, _ = extract(lattice, mi.Float(sunk.astype(np.float32))).to_numpy()
    column = found[(np.hypot(found[:, 0], found[:, 1]) < cell) & (found[:, 2] > 0)]
    np.testing.assert_allclose(column[:, 2], RADIUS - deep, atol=0.2 * cell)
    told = topology(found, triangles)
    assert (told.boundary_loops, told.components) == (0, 1)
    assert trimesh.Trimesh(found, triangles, process=False).euler_number == 2
    assert np.linalg.norm(found, axis=1).max() < RADIUS + 0.1 * cell
