"""Damped diffusion against the sparse linear system that it approximates."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from gshell_mi.block_lattice import BlockLattice
from gshell_mi.fields import smoothing
from gshell_mi.fields.smoothing import LatticeDiffusion
from gshell_mi.lattice import TetLattice

N = 9
LATTICE = TetLattice(N - 1)


@pytest.fixture
def field() -> np.ndarray:
    return np.random.default_rng(5).normal(size=N**3).astype(np.float32)


def solve(field: np.ndarray, smoothing: float) -> np.ndarray:
    """(I + smoothing L)^-1 with the combinatorial Laplacian of the N^3 grid."""
    line = sp.diags([np.ones(N - 1), np.ones(N - 1)], [-1, 1])
    one = sp.eye(N)
    adjacency = (sp.kron(sp.kron(line, one), one) + sp.kron(sp.kron(one, line), one)
                 + sp.kron(sp.kron(one, one), line))
    return spsolve((sp.eye(N**3) + smoothing * sp.csgraph.laplacian(adjacency)).tocsc(), field)


@pytest.mark.parametrize("smoothing", [0.5, 2.0, 8.0])
def test_converges_to_the_linear_system(field, smoothing):
    exact = solve(field, smoothing)
    start = np.abs(field - exact).max()
    for iterations in (1, 4, 12, 40):
        found = LatticeDiffusion(LATTICE, iterations)(mi.Float(field), smoothing).numpy()
        error = np.abs(found - exact).max()
        # Jacobi's iteration matrix has this largest row sum.
        assert error <= (6 * smoothing / (1 + 6 * smoothing)) ** iterations * start + 1e-6
    many = LatticeDiffusion(LATTICE, 600)(mi.Float(field), smoothing).numpy()
    np.testing.assert_allclose(many, exact, atol=1e-5)


def test_no_smoothing_changes_nothing(field):
    np.testing.assert_array_equal(LatticeDiffusion(LATTICE)(mi.Float(field), 0).numpy(), field)


@pytest.mark.parametrize("smoothing", [0.5, 8.0])
def test_constants_stay_and_mass_is_kept(field, smoothing):
    diffuse = LatticeDiffusion(LATTICE)
    np.testing.assert_allclose(diffuse(mi.Float([3.0] * N**3), smoothing).numpy(), 3, rtol=1e-5)
    spike = np.zeros((N, N, N), np.float32)
    spike[4, 4, 4], spike[0, 0, 3] = 1, 2  # one inside, one on the cube's edge
    result = diffuse(mi.Float(spike.ravel()), smoothing).numpy()
    assert result.min() >= 0
    assert result.sum(dtype=np.float64) == pytest.approx(3, rel=1e-5)
    result = diffuse(mi.Float(field), smoothing).numpy()
    assert result.sum(dtype=np.float64) == pytest.approx(field.sum(dtype=np.float64), abs=1e-3)
    assert result.std() < 0.8 * field.std()


def test_reaches_as_many_cells_as_it_iterates():
    spike = np.zeros((N, N, N), np.float32)
    spike[0, 0, 0] = 1
    result = LatticeDiffusion(LATTICE, iterations=3)(mi.Float(spike.ravel()), 2.0).numpy()
    z, y, x = np.indices((N, N, N))
    np.testing.assert_array_equal(result.reshape(N, N, N) > 0, x + y + z <= 3)


def test_channels_do_not_mix(field):
    diffuse = LatticeDiffusion(LATTICE)
    colors = np.stack([field, 2 * field, field[::-1]], axis=1)
    result = diffuse(mi.Float(colors.ravel()), 2.0).numpy().reshape(-1, 3)
    for channel in range(3):
        single = diffuse(mi.Float(np.ascontiguousarray(colors[:, channel])), 2.0).numpy()
        np.testing.assert_allclose(result[:, channel], single, atol=1e-6)


@pytest.mark.parametrize("channels", [1, 3])
def test_extend(channels):
    """A value known on one slab, weighted, spreads: the known keep theirs, the far away stay unknown."""
    rng = np.random.default_rng(2)
    z = np.indices((N, N, N))[0].ravel()
    weight = np.where(z == 0, rng.uniform(0.1, 2, N**3), 0).astype(np.float32)
    value = rng.uniform(1, 2, (N**3, channels)).astype(np.float32)
    diffuse = LatticeDiffusion(LATTICE, iterations=4)
    extended, known = diffuse.extend(mi.Float((weight[:, None] * value).ravel()), mi.Float(weight))
    extended, known = extended.numpy().reshape(-1, channels), known.numpy()
    np.testing.assert_allclose(extended[z == 0], value[z == 0], rtol=1e-6)
    np.testing.assert_array_equal(known, z <= 4)
    assert (extended[~known] == 0).all()
    reached = extended[known]
    assert reached.min() >= 1 - 1e-5 and reached.max() <= 2 + 1e-5, "a mean lies between what it is of"


def test_extend_keeps_constants():
    weight = np.zeros(N**3, np.float32)
    weight[[5, 300, 301]] = [0.01, 1, 30]
    extended, known = LatticeDiffusion(LATTICE).extend(mi.Float(7 * weight), mi.Float(weight))
    np.testing.assert_allclose(extended.numpy()[known.numpy()], 7, rtol=1e-5)
    assert dr.count(known)[0] > 500


@pytest.mark.parametrize("kept", [0, 1 << 22])
def test_same_in_blocks_but_near_their_edge(kept: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(smoothing, "_NEIGHBOURS_KEPT", kept)
    lattice, reach = TetLattice(70), 4
    sdf = dr.norm(lattice.points(mi.Float)) - 0.5
    blocks = BlockLattice.around(lattice, sdf)
    rng = np.random.default_rng(0)
    field = mi.Float(rng.normal(size=lattice.vertex_count).astype(np.float32))
    dense = blocks.take(LatticeDiffusion(lattice, reach)(field, 8.0)).numpy()
    stored = LatticeDiffusion(blocks, reach)(blocks.take(field), 8.0).numpy()
    near = np.abs(blocks.take(sdf).numpy()) < 0.5 * lattice.spacing  # the edge is four cells away
    assert near.sum() > 1000
    np.testing.assert_array_equal(stored[near], dense[near])


def test_constants_stay_in_blocks():
    lattice = TetLattice(70)
    blocks = BlockLattice.around(lattice, lattice.points(mi.Float).x - 0.3)
    result = LatticeDiffusion(blocks)(dr.full(mi.Float, 2.5, blocks.vertex_count), 8.0)
    np.testing.assert_allclose(result.numpy(), 2.5, rtol=1e-5)
