import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.extraction import extract
from gshell_mi.fields.carried import Carried
from gshell_mi.lattice import BlockLattice, TetLattice

LATTICE = TetLattice(80)


def _ball(points, radius):
    return dr.norm(points) - radius


@pytest.fixture
def move():
    """Blocks around a small ball and around a larger one; both store some of each."""
    before, after = (BlockLattice.around(LATTICE, lambda p, r=r: _ball(p, r), mi.Float) for r in (0.3, 0.42))
    return Carried(before, after)


def _both(move):
    """Stored vertices of after that before has too, and where they are in it."""
    ids = [
        lattice.lattice_vertex(dr.arange(mi.UInt32, lattice.vertex_count)).numpy()
        for lattice in (move.before, move.after)
    ]
    exists = [
        np.unpackbits(lattice.exists.numpy().view(np.uint8), bitorder="little").astype(bool)
        for lattice in (move.before, move.after)
    ]
    kept = np.isin(ids[1], ids[0][exists[0]]) & exists[1]
    where = np.searchsorted(ids[0][exists[0]], ids[1][kept])
    return kept, np.flatnonzero(exists[0])[where], exists[1]


def test_what_both_store_is_copied(move):
    kept, where, exists = _both(move)
    assert 1000 < kept.sum() < 0.8 * exists.sum()
    rng = np.random.default_rng(0)
    for channels in (1, 3):
        field = rng.normal(size=(move.before.vertex_count, channels)).astype(np.float32)
        for carry in (move.values, move.moments):
            carried = carry(mi.Float(field.ravel())).numpy().reshape(-1, channels)
            np.testing.assert_array_equal(carried[kept], field[where])
        assert (carried[exists & ~kept] == 0).all()  # no past


def test_new_vertices_take_the_value_of_the_nearest(move):
    kept, _, exists = _both(move)
    x = move.before.points(mi.Float).x
    carried, truth = move.values(x).numpy(), move.after.points(mi.Float).x.numpy()
    off = np.abs(carried - truth)[exists] / LATTICE.spacing
    assert off[kept[exists]].max() == 0
    assert 1 < off.max() < 32  # a block is that long


def test_signed_distance_grows_and_moves_no_surface(move):
    field = _ball(move.before.points(mi.Float), 0.3)
    carried = move.sdf(field)
    assert np.isfinite(carried.numpy()).all()
    old, new = extract(move.before, field), extract(move.after, carried)
    inner = np.linalg.norm(new.to_numpy()[0], axis=1)
    assert new.face_count <= old.face_count and np.abs(inner - 0.3).max() < 1e-2
    # Outside of the surface, where there was nothing before, the distance is right to first order.
    kept, _, exists = _both(move)
    radius = dr.norm(move.after.points(mi.Float)).numpy()
    outside = exists & ~kept & (radius > 0.35)
    assert outside.sum() > 1000
    assert (carried.numpy()[outside] > 4 * LATTICE.spacing).all()
    assert np.abs(carried.numpy() - (radius - 0.3))[outside].max() < 20 * LATTICE.spacing


def test_signs_at_the_edge_hold():
    """Values at the edge that have changed sign make no surface in the blocks beyond."""
    before = BlockLattice.around(LATTICE, lambda p: _ball(p, 0.3), mi.Float)
    p = before.points(mi.Float)
    flipped = dr.select(dr.abs(p.x) < 0.9, -dr.abs(_ball(p, 0.3)) - 0.01, 1)  # open at the lattice's border
    assert not before.covers(extract(before, flipped).cells)
    after = before.around_cells(
        extract(before, flipped).cells, lambda new: Carried(before, new).sdf(flipped), keep=True
    )
    values = Carried(before, after).sdf(flipped)
    mesh = extract(after, values)
    assert mesh.face_count > 1000 and mesh.to_trimesh().is_watertight


def test_optimizer_state_is_carried_per_block(move):
    rng = np.random.default_rng(1)
    n = move.before.vertex_count
    start = {
        "sdf": _ball(move.before.points(mi.Float), 0.3),
        "deform": mi.Float(rng.normal(size=3 * n)),
        "light": mi.Float(1, 2, 3),
    }
    optimizer = mi.ad.Adam(lr=0.01, params=start)
    for _ in range(3):
        for name in start:
            dr.set_grad(optimizer[name], mi.Float(rng.normal(size=dr.width(start[name]))))
        optimizer.step()
    before = {
        name: (value.numpy(), first.numpy(), second.numpy())
        for name, (value, _, _, (_, first, second, _)) in optimizer.state.items()
    }
    move.optimizer(optimizer, ("sdf", "deform"))
    kept, where, exists = _both(move)
    for name, channels in (("sdf", 1), ("deform", 3)):
        value, _, _, (step, first, second, _) = optimizer.state[name]
        assert dr.grad_enabled(value) and step[0] == 3
        for now, then in zip((value, first, second), before[name], strict=True):
            now, then = now.numpy().reshape(-1, channels), then.reshape(-1, channels)
            assert len(now) == move.after.vertex_count
            np.testing.assert_array_equal(now[kept], then[where])
        for moment in (first, second):
            assert (moment.numpy().reshape(-1, channels)[exists & ~kept] == 0).all()
    assert dr.width(optimizer["light"]) == 3
    for name in start:
        dr.set_grad(optimizer[name], dr.ones(mi.Float, dr.width(optimizer[name])))
    optimizer.step()
    assert np.isfinite(optimizer["sdf"].numpy()).all()
