import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial import cKDTree
from topology import assert_manifold, boundary_edges

from gshell_mi import UserError
from gshell_mi.extraction import extract
from gshell_mi.lattice import GRIDS, BlockLattice, TetLattice, make_lattice


def test_a_grid_without_blocks_is_refused():
    with pytest.raises(UserError, match="'bcc' cannot be stored in blocks"):
        BlockLattice.around(make_lattice("bcc", 70), _ball, mi.Float)


@pytest.fixture(params=[grid for grid in GRIDS if make_lattice(grid, 8).fits_in_blocks])
def lattice(request):
    return make_lattice(request.param, 70)


def _assert_equal(a, b):
    for x, y in zip(a.to_numpy(), b.to_numpy(), strict=True):
        _assert_equal_numbers(x, y)


def _assert_equal_numbers(x, y):
    """Bit by bit, but on a GPU, whose compiler fuses multiplications and additions as it likes."""
    if np.issubdtype(x.dtype, np.floating) and mi.variant().startswith("cuda"):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-7)
    else:
        np.testing.assert_array_equal(x, y)


def _ball(points, radius=0.3, x=0.0, y=0.0):
    return dr.norm(mi.Vector3f(points.x - x, points.y - y, points.z)) - radius


def _fields(lattice, x):
    """A ball that moves, grows and is cut, with random offsets; ``weights`` as for all cells of n^3."""
    p, rng = lattice.points(mi.Float), np.random.default_rng(0)
    fields = {
        "sdf": _ball(p, 0.25 + 0.1 * x, x),
        "msdf": 0.1 - p.z,
        "deform": mi.Float(rng.uniform(-1, 1, 3 * lattice.vertex_count).astype(np.float32)),
    }
    if lattice.weight_count:
        fields["weights"] = mi.Float(rng.normal(size=lattice.weight_count).astype(np.float32))
    return fields


def _taken(blocks, fields):
    """The fields at the stored vertices."""
    taken = {name: blocks.take(field) for name, field in fields.items() if name != "weights"}
    if "weights" in fields:
        n = blocks.resolution
        vertex = blocks.lattice_vertex(dr.arange(mi.UInt32, blocks.vertex_count)).numpy()
        x, y, z = vertex % (n + 1), vertex // (n + 1) % (n + 1), vertex // (n + 1) ** 2
        cube = np.minimum(x, n - 1) + n * (np.minimum(y, n - 1) + n * np.minimum(z, n - 1))
        taken["weights"] = mi.Float(fields["weights"].numpy().reshape(-1, 21)[cube].ravel())
    return taken


def test_same_mesh_while_the_blocks_follow_the_surface(lattice):
    """Bit by bit, up to where the ball touches the border of the lattice."""
    blocks = None
    for x in np.arange(0.19, 0.75, 0.07):  # of less than 2.8 cells
        fields = _fields(lattice, x)
        if blocks is None:
            blocks = BlockLattice.around(lattice, fields["sdf"])
        taken = _taken(blocks, fields)
        mesh = extract(blocks, **taken, template=True)
        dense = extract(lattice, **fields, template=True)
        assert mesh.face_count > 100
        _assert_equal(mesh, dense)
        _assert_equal(mesh.template, dense.template)
        color = lattice.points(mi.Float).y
        _assert_equal_numbers(mesh.interpolate(blocks.take(color)).numpy(), dense.interpolate(color).numpy())
        blocks = blocks.around_cells(mesh.cells, lambda new, sdf=fields["sdf"]: new.take(sdf))
        assert blocks.fraction < 0.5 and blocks.covers(extract(blocks, **_taken(blocks, fields)).cells)


def test_same_gradients(lattice):
    fields = _fields(lattice, 0.1)
    blocks = BlockLattice.around(lattice, fields["sdf"])
    gradients = []
    for on, values in ((lattice, fields), (blocks, _taken(blocks, fields))):
        dr.enable_grad(list(values.values()))
        mesh = extract(on, **values)
        dr.backward(dr.sum(dr.squared_norm(mesh.vertices)) + dr.sum(mesh.msdf))
        gradients.append({name: dr.grad(value) for name, value in values.items()})
    dense, stored = gradients
    for name, gradient in _taken(blocks, dense).items():
        np.testing.assert_allclose(stored[name].numpy(), gradient.numpy(), rtol=1e-4, atol=1e-5)
        assert dr.max(dr.abs(gradient))[0] > 0.001
        # All that there is arrived: nothing of it lies outside of the blocks.
        np.testing.assert_allclose(*(np.abs(g[name].numpy()).sum() for g in gradients), rtol=1e-4)


def test_surface_near_the_edge_is_not_covered():
    lattice = TetLattice(70)
    ball = _ball(lattice.points(mi.Float))
    blocks = BlockLattice.around(lattice, ball)
    sdf = blocks.take(ball)
    for cells, covered in ((0, True), (9, False)):
        mesh = extract(blocks, sdf - cells * lattice.spacing)
        assert blocks.covers(mesh.cells) == covered
    grown = blocks.around_cells(mesh.cells, lambda new: new.take(ball), keep=True)
    assert set(blocks.blocks.numpy()) < set(grown.blocks.numpy())


def test_surface_never_runs_out_of_the_blocks(lattice):
    """Whatever the values are: manifold, and closed but at the border of the lattice."""
    lattice = make_lattice(lattice.grid, 40)
    p = lattice.points(mi.Float)
    for seed, x in enumerate((0.0, 0.8)):  # inside; cut off by the border
        rng = np.random.default_rng(seed)
        blocks = BlockLattice.around(lattice, _ball(p, 0.2, x))
        sdf, msdf, deform = (
            mi.Float(rng.uniform(-1, 1, n * blocks.vertex_count).astype(np.float32)) for n in (1, 1, 3)
        )
        mesh = extract(blocks, sdf, msdf, deform, template=True)
        assert mesh.face_count > 5000
        assert_manifold(*mesh.to_numpy()[:2])
        vertices, faces, _ = mesh.template.to_numpy()
        assert_manifold(vertices, faces)
        ends = vertices[boundary_edges(faces)].reshape(-1, 3)
        at_border = np.abs(ends).max(axis=1) > 1 - 2 * lattice.max_offset
        assert at_border.all() and (len(ends) == 0) == (lattice.grid == "flexicubes")


def test_blocks_around_random_values_can_be_followed():
    """Signs of all stored values change at once, the worst that an optimiser may do."""
    lattice = TetLattice(70)
    blocks = BlockLattice.around(lattice, _ball(lattice.points(mi.Float), 0.2))
    for seed in range(4):

        def values(on, seed=seed):
            return mi.Float(np.random.default_rng(seed).normal(size=on.vertex_count).astype(np.float32))

        mesh = extract(blocks, values(blocks))
        assert not blocks.covers(mesh.cells)
        edge = blocks.edge
        blocks = blocks.around_cells(
            mesh.cells, lambda new: dr.full(mi.Float, 0.5, new.vertex_count), keep=True
        )
        assert dr.width(edge) < dr.width(blocks.edge)


def test_finds_the_same_blocks_of_a_function_and_of_values(lattice):
    def sdf(p):
        return dr.minimum(_ball(p, 0.15, y=-0.7), _ball(p, 0.15, y=0.7))

    given = BlockLattice.around(lattice, sdf(lattice.points(mi.Float)))
    found = BlockLattice.around(lattice, sdf, mi.Float)
    for name in ("blocks", "edge", "beyond"):
        np.testing.assert_array_equal(getattr(given, name).numpy(), getattr(found, name).numpy())
    assert extract(found, sdf(found.points(mi.Float))).to_trimesh().body_count == 2


def test_same_mesh_of_a_body_that_the_border_cuts(lattice):
    """FlexiCubes close it along the border, blocks away from any change of the sign."""
    lattice = make_lattice(lattice.grid, 140)

    def sdf(p):
        return dr.norm(mi.Vector3f(p.x, p.y, p.z + 1)) - 0.9

    whole = sdf(lattice.points(mi.Float))
    for blocks in (BlockLattice.around(lattice, whole), BlockLattice.around(lattice, sdf, mi.Float)):
        _assert_equal(extract(blocks, blocks.take(whole)), extract(lattice, whole))


def test_stored_vertices_are_those_of_the_lattice(lattice):
    p = lattice.points(mi.Float)
    blocks = BlockLattice.around(lattice, _ball(p, 0.5, x=0.6))
    vertex = dr.arange(mi.UInt32, blocks.vertex_count)
    inside = (blocks.exists.numpy()[vertex.numpy() >> 5] >> (vertex.numpy() & 31) & 1).astype(bool)
    assert 0 < (~inside).sum() < inside.sum()
    ids = blocks.lattice_vertex(vertex).numpy()[inside].astype(np.int64)
    assert (np.diff(ids) > 0).all()
    np.testing.assert_array_equal(blocks.points(mi.Float).numpy().T[inside], p.numpy().T[ids])
    colors = mi.Float(np.arange(3 * lattice.vertex_count, dtype=np.float32))
    np.testing.assert_array_equal(blocks.take(colors).numpy().reshape(-1, 3)[inside][:, 1], 3 * ids + 1)
    stored = set(ids)
    shape = (lattice.stride,) * 3
    coordinates = np.array(np.unravel_index(ids, shape))[::-1]
    for axis in range(3):
        for up, step in ((False, -1), (True, 1)):
            found = blocks.neighbour(vertex, mi.UInt32(axis), mi.Bool(up)).numpy()[inside]
            there = coordinates[axis] + step
            expected = ids + step * lattice.stride**axis
            exists = (there >= 0) & (there < lattice.stride) & np.isin(expected, list(stored))
            assert (found[~exists] == 0xFFFFFFFF).all()
            np.testing.assert_array_equal(
                blocks.lattice_vertex(mi.UInt32(found[exists])).numpy(), expected[exists]
            )


def test_no_surface():
    lattice = TetLattice(40)
    blocks = BlockLattice.around(lattice, dr.full(mi.Float, -1, lattice.vertex_count))
    assert extract(blocks, dr.full(mi.Float, -1, blocks.vertex_count)).is_empty
    assert blocks.covers(extract(blocks, dr.full(mi.Float, -1, blocks.vertex_count)).cells)


@pytest.mark.parametrize("name", ["sdf", "msdf", "deform"])
def test_non_finite_values(name):
    lattice = TetLattice(40)
    p = lattice.points(mi.Float)
    blocks = BlockLattice.around(lattice, _ball(p))
    fields = {
        "sdf": blocks.take(_ball(p)),
        "msdf": blocks.take(p.z),
        "deform": dr.zeros(mi.Float, 3 * blocks.vertex_count),
    }
    values = fields[name].numpy()
    values[len(values) // 2] = np.nan
    fields[name] = mi.Float(values)
    with pytest.raises(UserError, match=f"^{name} holds NaN or infinite values"):
        extract(blocks, **fields)


def test_user_mistakes():
    lattice = TetLattice(40)
    sdf = _ball(lattice.points(mi.Float))
    with pytest.raises(UserError, match="sdf has 5 values, but the lattice needs 68921"):
        BlockLattice.around(lattice, dr.zeros(mi.Float, 5))
    with pytest.raises(UserError, match=r"the surface of sdf runs out of the blocks; BlockLattice\.around"):
        BlockLattice(lattice, mi.UInt32(0, 121, 122), lambda blocks: blocks.take(sdf))
    blocks = BlockLattice.around(lattice, sdf)
    with pytest.raises(UserError, match=f"sdf has 68921 values, but the lattice needs {blocks.vertex_count}"):
        extract(blocks, sdf)


def test_what_is_not_stored_is_as_what_is_next_to_it(lattice):
    blocks = BlockLattice.around(lattice, _ball, mi.Float)
    points = blocks.points(mi.Float)
    whole = blocks.spread_out(dr.ravel(points)).numpy().reshape(-1, 3)
    everywhere = lattice.points(mi.Float).numpy().T
    exists = blocks.in_lattice(dr.arange(mi.UInt32, blocks.vertex_count)).numpy()
    vertex = blocks.lattice_vertex(dr.arange(mi.UInt32, blocks.vertex_count)).numpy()[exists]
    np.testing.assert_array_equal(whole[vertex], everywhere[vertex])
    _assert_equal_numbers(
        blocks.take(mi.Float(whole.ravel())).numpy().reshape(-1, 3)[exists], points.numpy().T[exists]
    )
    nearest, _ = cKDTree(everywhere[vertex]).query(everywhere)
    np.testing.assert_allclose(np.linalg.norm(whole - everywhere, axis=1), nearest, atol=1e-5)
