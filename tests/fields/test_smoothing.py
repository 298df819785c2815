"""Damped diffusion against the sparse linear system that it approximates."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.sparse as sp
import trimesh
from scipy.ndimage import binary_dilation
from scipy.sparse.linalg import spsolve

from gshell_mi.fields import smoothing
from gshell_mi.fields.smoothing import LatticeDiffusion, MeshDiffusion
from gshell_mi.lattice import BlockLattice, Lattice, TetLattice, make_lattice
from gshell_mi.lattice.sign_scan import active_cells, vertices_near

N = 9
LATTICE = TetLattice(N - 1)


@pytest.fixture
def field() -> np.ndarray:
    return np.random.default_rng(5).normal(size=N**3).astype(np.float32)


def solve(field: np.ndarray, smoothing: float) -> np.ndarray:
    """(I + smoothing L)^-1 with the combinatorial Laplacian of the N^3 grid."""
    line = sp.diags([np.ones(N - 1), np.ones(N - 1)], [-1, 1])
    one = sp.eye(N)
    adjacency = (
        sp.kron(sp.kron(line, one), one) + sp.kron(sp.kron(one, line), one) + sp.kron(sp.kron(one, one), line)
    )
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


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_fields_that_are_added_to_just_before(count):
    """As gradients are; any number of them together is what each is alone."""

    def spike(at):
        field = dr.zeros(mi.Float, N**3)
        dr.scatter_reduce(dr.ReduceOp.Add, field, mi.Float(1), mi.UInt32(at))
        return field

    diffuse = LatticeDiffusion(LATTICE)
    together = diffuse.together({str(i): spike(40 * i) for i in range(count)}, 2.0)
    assert list(together) == [str(i) for i in range(count)]
    for i in range(count):
        alone = diffuse(spike(40 * i), 2.0)
        assert dr.any(alone != 0)
        np.testing.assert_allclose(together[str(i)].numpy(), alone.numpy(), atol=1e-6)


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


def surface_cells(lattice: Lattice) -> mi.UInt32:
    """Of an oblique sheet that runs out of the lattice, with a ball beside it that touches two borders."""
    p = lattice.points(mi.Float)
    ball = dr.norm(p - mi.Point3f(0.8, 0.1, -0.8)) - 0.3
    return active_cells(dr.minimum(0.6 * p.x + 0.3 * p.y - 0.7 * p.z + 0.4, ball), lattice)[0]


@pytest.mark.parametrize(
    "lattice",
    [make_lattice(grid, n) for grid, n in (("tet", 13), ("cube", 31), ("flexicubes", 10), ("bcc", 12))],
    ids=lambda lattice: lattice.grid,
)
@pytest.mark.parametrize("reach", [1, 3, 5])
def test_vertices_near_cells(lattice: Lattice, reach: int):
    """All that are in reach, and nearly none that is a good deal farther."""
    cells = surface_cells(lattice)
    corners = np.concatenate([lattice.corner(cells, mi.UInt32(corner)).numpy() for corner in range(8)])
    exists = np.zeros((len(lattice.grids), *3 * (lattice.stride,)), bool)
    # The corners of cells that the lattice ends in are not looked at: they have been wrapped around.
    exists.ravel()[corners[corners < lattice.vertex_count]] = True
    exact = np.stack([binary_dilation(grid, np.ones(3 * (2 * reach + 1,))) for grid in exists]).ravel()
    found = vertices_near(cells, lattice, reach).numpy()
    assert (np.diff(found) > 0).all()
    near = np.zeros(lattice.vertex_count, bool)
    near[found] = True
    assert near[exact].all()
    assert near.sum() < exact.sum() + 0.2 * lattice.vertex_count


def test_no_cell_is_near_nothing(field):
    lattice = TetLattice(N - 1)
    assert dr.width(vertices_near(mi.UInt32(), lattice, 3)) == 0
    np.testing.assert_array_equal(LatticeDiffusion(lattice, cells=mi.UInt32())(mi.Float(field), 8.0), field)


def test_near_cells_the_others_keep_their_values():
    lattice = TetLattice(40)
    cells = surface_cells(lattice)
    near = np.zeros(lattice.vertex_count, bool)
    near[vertices_near(cells, lattice, smoothing.NEAR).numpy()] = True
    assert 0.2 < near.mean() < 0.8
    field = np.random.default_rng(3).normal(size=(lattice.vertex_count, 3)).astype(np.float32)
    diffuse = LatticeDiffusion(lattice, cells=cells)
    result = diffuse(mi.Float(field.ravel()), 8.0).numpy().reshape(-1, 3)
    np.testing.assert_array_equal(result[~near], field[~near])
    np.testing.assert_allclose(result[near].sum(axis=0, dtype=np.float64), field[near].sum(axis=0), atol=1e-2)
    for channel in range(3):
        single = diffuse(mi.Float(np.ascontiguousarray(field[:, channel])), 8.0).numpy()
        np.testing.assert_allclose(result[:, channel], single, atol=1e-6)


def test_near_cells_it_is_the_same_but_near_the_edge():
    lattice, iterations = TetLattice(40), 2
    cells = surface_cells(lattice)
    field = mi.Float(np.random.default_rng(0).normal(size=lattice.vertex_count).astype(np.float32))
    whole = LatticeDiffusion(lattice, iterations)(field, 8.0).numpy()
    limited = LatticeDiffusion(lattice, iterations, cells)(field, 8.0).numpy()
    # What is as far from the edge as the iterations reach has felt nothing of it.
    inner = vertices_near(cells, lattice, smoothing.NEAR - iterations).numpy()
    assert len(inner) > 1000
    np.testing.assert_array_equal(limited[inner], whole[inner])


def test_a_mesh_is_solved_exactly_and_all_fields_together():
    sphere = trimesh.creation.icosphere(subdivisions=2)
    count, (start, end) = len(sphere.vertices), sphere.edges_unique.T
    adjacency = sp.coo_matrix((np.ones(len(start)), (start, end)), shape=(count, count))
    system = sp.eye(count) + 7.0 * sp.csgraph.laplacian(adjacency + adjacency.T)
    diffuse = MeshDiffusion(sphere.faces, count, 7.0)
    random = np.random.default_rng(0)
    fields = {
        name: random.normal(size=(count, channels)).astype(np.float32)
        for name, channels in (("logit", 1), ("front", 3), ("back", 3), ("gloss", 1), ("pair", 2))
    }
    given = {name: mi.Float(field.ravel()) for name, field in fields.items()}
    together = diffuse.together(given)
    assert list(together) == list(fields) and diffuse.together({}) == {}
    for name, field in fields.items():
        exact = spsolve(system.tocsc(), field).reshape(field.shape)
        np.testing.assert_allclose(together[name].numpy().reshape(field.shape), exact, atol=1e-5)
        np.testing.assert_array_equal(together[name].numpy(), diffuse(given[name]).numpy())
