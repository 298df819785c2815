"""Regularisers of the signed distance."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from closed_form import value

from gshell_mi import losses
from gshell_mi.lattice import BlockLattice, TetLattice

LATTICE = TetLattice(12)


def field(function) -> mi.Float:
    """A function of (n, 3) points in cells, at the lattice's vertices."""
    return mi.Float(function(LATTICE.vertex_positions() / LATTICE.spacing).astype(np.float32))


def test_sign_cross_entropy_of_a_plane():
    """Every crossed edge has the ends -h and 1 - h: softplus(1 - h) + softplus(h)."""
    for h in (0.25, 0.5):
        expected = np.log1p(np.exp(1 - h)) + np.log1p(np.exp(h))
        found = value(losses.sign_cross_entropy(field(lambda p, h=h: p[:, 0] + 1 - h), LATTICE))
        assert found == pytest.approx(expected, rel=1e-4)


def test_sign_cross_entropy_without_a_surface():
    assert value(losses.sign_cross_entropy(field(lambda p: 2 + 0 * p[:, 0]), LATTICE)) == 0


def test_descent_on_the_sign_cross_entropy_removes_a_floater():
    sdf = field(lambda p: np.linalg.norm(p, axis=1) - 3.3)
    speck = 1 + LATTICE.stride + LATTICE.stride**2
    dr.scatter(sdf, mi.Float(-0.2), mi.UInt32(speck))
    for _ in range(40):
        dr.enable_grad(sdf)
        dr.backward(losses.sign_cross_entropy(sdf, LATTICE))
        sdf = dr.detach(sdf) - 20 * dr.grad(sdf)
        dr.eval(sdf)
    assert sdf[speck] > 0
    inside = LATTICE.vertex_positions()[sdf.numpy() < 0] / LATTICE.spacing
    assert len(inside) > 80 and np.linalg.norm(inside, axis=1).max() < 4, "the ball is still there"


def test_eikonal_of_distances():
    """Forward differences of the distance to a plane are exact, of that to a point to second order."""
    slanted = np.array([2, 1, 2]) / 3
    assert value(losses.eikonal(field(lambda p: p @ slanted), LATTICE)) == pytest.approx(0, abs=1e-6)
    sphere = losses.eikonal(field(lambda p: np.linalg.norm(p, axis=1) - 4.5), LATTICE, reach=1)
    assert value(sphere) < 0.01
    assert value(losses.eikonal(field(lambda p: 0.5 * p @ slanted), LATTICE)) == pytest.approx(0.25, abs=1e-5)


def test_eikonal_looks_near_the_surface_only():
    def kinked(p):
        return np.where(abs(p[:, 0]) <= 2, p[:, 0], 5 * p[:, 0])

    assert value(losses.eikonal(field(kinked), LATTICE, reach=1)) == pytest.approx(0, abs=1e-6)
    assert value(losses.eikonal(field(kinked), LATTICE, reach=100)) > 1
    assert value(losses.eikonal(field(lambda p: 9 + 0 * p[:, 0]), LATTICE)) == 0, "no surface"


@pytest.mark.parametrize("loss", [losses.eikonal, losses.sign_cross_entropy])
def test_derivatives_agree_with_finite_differences(loss):
    rng = np.random.default_rng(5)
    noise = mi.Float(rng.normal(0, 0.2, LATTICE.vertex_count))
    start = field(lambda p: np.linalg.norm(p, axis=1) - 4) + noise
    direction = mi.Float(rng.normal(size=LATTICE.vertex_count).astype(np.float32))
    # Vertices at a sign change or at the reach would make the loss jump.
    quiet = (dr.abs(start) > 0.02) & (dr.abs(dr.abs(start) - 3) > 0.02)
    direction = dr.select(quiet, direction, 0)
    sdf = mi.Float(start)
    dr.enable_grad(sdf)
    dr.backward(loss(sdf, LATTICE))
    along = dr.sum(dr.grad(sdf) * direction)[0]
    step = 2e-3
    up, down = (value(loss(start + sign * step * direction, LATTICE)) for sign in (1, -1))
    assert along == pytest.approx((up - down) / (2 * step), rel=0.02, abs=1e-4)


def test_same_in_blocks_around_the_surface():
    lattice = TetLattice(40)
    points = lattice.points(mi.Float)
    sdf = (dr.norm(points) - 0.5 + 0.02 * dr.sin(20 * points.x)) / lattice.spacing
    blocks = BlockLattice.around(lattice, sdf)
    for loss in (losses.sign_cross_entropy, lambda s, on: losses.eikonal(s, on, reach=2.0)):
        np.testing.assert_allclose(loss(blocks.take(sdf), blocks)[0], loss(sdf, lattice)[0], rtol=1e-5)
