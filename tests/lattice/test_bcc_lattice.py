"""The body-centred cubic lattice: where its vertices are and what joins them."""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi import UserError
from gshell_mi.extraction.tet_tables import TETS
from gshell_mi.fields.interpolation import Interpolation
from gshell_mi.lattice import MISSING, BccLattice, BlockLattice, lattice_of
from gshell_mi.lattice.lattice import MAX_OFFSET_CELLS_BCC

RESOLUTIONS = (1, 2, 3, 5)


def corner_vectors() -> np.ndarray:
    """The eight corners of a squeezed cell, in half cells."""
    basis = np.array(BccLattice.BASIS)
    return np.array([[corner >> i & 1 for i in range(3)] @ basis for corner in range(8)])


def vertices(lattice) -> mi.UInt32:
    return dr.arange(mi.UInt32, lattice.vertex_count)


def test_two_grids_within_the_cube():
    lattice = BccLattice(4)
    positions = lattice.vertex_positions()
    assert positions.shape == (2 * 5**3, 3)
    assert positions.min() == -1 and positions.max() == pytest.approx(1)
    np.testing.assert_allclose(positions[125:], positions[:125] + lattice.spacing / 2, atol=1e-6)
    np.testing.assert_allclose(np.array(lattice.points(mi.Float)).T, positions, atol=1e-6)
    assert lattice.on_border().sum() == 2 * (5**3 - 3**3)


@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_corners(resolution):
    lattice = BccLattice(resolution)
    positions = lattice.vertex_positions()
    place = {tuple(p): i for i, p in enumerate(np.rint((positions + 1) / lattice.spacing * 2).astype(int))}
    for corner, vector in enumerate(corner_vectors()):
        found = lattice.corner(vertices(lattice), mi.UInt32(corner)).numpy()
        wanted = [place.get(tuple(np.array(p) + vector), MISSING) for p in place]
        np.testing.assert_array_equal(found, wanted)
        for vertex in np.flatnonzero(found != MISSING):
            offset = lattice.corner_offset(corner, bool(vertex >= (resolution + 1) ** 3))
            assert vertex + offset == found[vertex]


@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_neighbours(resolution):
    """Inside the lattice there are eight, half a diagonal away."""
    lattice = BccLattice(resolution)
    positions = lattice.vertex_positions()
    found = np.array([n.numpy() for n in lattice.neighbours(vertices(lattice))])
    distance = np.linalg.norm(positions[found] - positions, axis=2)
    itself = found == np.arange(lattice.vertex_count)
    np.testing.assert_allclose(distance[~itself], 3**0.5 / 2 * lattice.spacing, rtol=1e-4)
    assert not itself[:, ~lattice.on_border()].any()
    assert all(len(set(row[keep])) == keep.sum() for row, keep in zip(found.T, ~itself.T, strict=True))


def test_no_offset_inverts_a_tetrahedron():
    # The volume is linear in each coordinate of each vertex, so the worst case is a corner of the box.
    offsets = np.array(list(itertools.product([-1, 1], repeat=12))).reshape(-1, 4, 3)
    for tet in TETS:
        rest = corner_vectors()[list(tet)] / 2
        sign = np.linalg.det(rest[1:] - rest[:-1])
        assert abs(sign) == pytest.approx(0.5), "all of one size"
        for scale, smallest in ((1 / 4, 0), (MAX_OFFSET_CELLS_BCC, 0.1 / 2)):
            moved = rest + scale * offsets
            volumes = np.sign(sign) * np.linalg.det(moved[:, 1:] - moved[:, :-1])
            assert volumes.min() == pytest.approx(smallest, abs=2e-3)


def test_interpolation():
    """Linear fields are exact, vertices keep their values, and nothing jumps."""
    lattice = BccLattice(6)
    rng = np.random.default_rng(0)
    p = lattice.points(mi.Float)
    inside = mi.Point3f(rng.uniform(-0.8, 0.7, (3, 2000)).astype(np.float32))
    linear = Interpolation(1 + 2 * p.x - 3 * p.y + 0.5 * p.z, lattice)
    wanted = 1 + 2 * inside.x - 3 * inside.y + 0.5 * inside.z
    np.testing.assert_allclose(linear(inside).numpy(), wanted.numpy(), atol=1e-5)
    noise = rng.normal(size=(lattice.vertex_count, 2)).astype(np.float32)
    field = Interpolation(mi.Float(noise.ravel()), lattice)
    inner = ~lattice.on_border()
    np.testing.assert_allclose(field(p).numpy().reshape(-1, 2)[inner], noise[inner], atol=1e-5)
    step = mi.Vector3f(1e-5, 2e-5, -1e-5)
    assert np.abs(field(inside + step).numpy() - field(inside).numpy()).max() < 2e-3


def test_the_size_of_a_field_tells_the_lattice():
    assert lattice_of("bcc", 250) == BccLattice(4)
    with pytest.raises(UserError, match=r"125 values are not 2 \(resolution \+ 1\)\^3, as grid 'bcc' needs"):
        lattice_of("bcc", 125)


def test_it_cannot_be_stored_in_blocks():
    lattice = BccLattice(40)
    with pytest.raises(UserError, match="grid 'bcc' cannot be stored in blocks"):
        BlockLattice.around(lattice, dr.norm(lattice.points(mi.Float)) - 0.5)
