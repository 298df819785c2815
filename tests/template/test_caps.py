"""Caps go on as the surface around them does."""

import mitsuba as mi
import numpy as np
import pytest
from cap import cap

from gshell_mi.extraction import extract
from gshell_mi.lattice import TetLattice
from gshell_mi.template.caps import dented, least_bent, put_in_place

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
def test_a_dent_is_about_as_deep_as_it_is_wide_from_rim_to_middle(ball, unit):
    """Where the ball is nearly flat."""
    place = np.where(cap(ball, [0, 0, 1], 0.01), 0, np.where(cap(ball, [1, 0, 0], 0.02), 1, -1))
    moved = dented(unit * ball.vertices, ball.faces, place) / unit
    np.testing.assert_allclose(moved[place < 0], ball.vertices[place < 0], atol=1e-12)
    for index, axis in enumerate(np.eye(3)[[2, 0]]):
        at = place == index
        radius = np.linalg.norm(ball.vertices[at] - axis, axis=1).max()
        depth = (ball.vertices - moved)[at] @ axis
        assert depth.max() == pytest.approx(radius, rel=0.4) and depth.min() > 0
        np.testing.assert_allclose(moved[at] + np.outer(depth, axis), ball.vertices[at], atol=0.02)


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
    smooth, told = put_in_place(sdf, scale * points, moved, faces, caps, scale * lattice.spacing)
    found = extract(lattice, mi.Float(smooth.astype(np.float32))).to_numpy()[0]
    before, after = (np.linalg.norm(at, axis=1).max() - RADIUS for at in (vertices, found))
    assert before > 2.8 * lattice.spacing and after < 0.7 * lattice.spacing
    far = np.linalg.norm(points - pole, axis=1) > 9 * lattice.spacing
    np.testing.assert_array_equal(smooth[far], sdf[far])
    assert not told[far].any() and told[np.linalg.norm(points - pole, axis=1) < lattice.spacing].all()
