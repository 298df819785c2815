import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi import UserError
from gshell_mi.extraction.tet_tables import TETS, corner_position
from gshell_mi.lattice import TetLattice
from gshell_mi.lattice.lattice import MAX_OFFSET_CELLS


def test_layout():
    lattice = TetLattice(3)
    positions = lattice.vertex_positions()
    assert positions.shape == (64, 3)
    np.testing.assert_allclose(positions[1 + 2 * 4 + 3 * 16], [-1 + 2 / 3, -1 + 4 / 3, 1], atol=1e-6)
    assert lattice.spacing == pytest.approx(2 / 3)
    np.testing.assert_allclose(np.array(lattice.points(mi.Float)).T, positions, atol=1e-6)


@pytest.mark.parametrize("resolution", [0, -4, 801])
def test_resolution_out_of_range(resolution):
    with pytest.raises(UserError, match=f"between 1 and 800 cells per side, not {resolution}"):
        TetLattice(resolution)


def _volumes(offsets: np.ndarray, tet: int) -> np.ndarray:
    """Signed volumes, times 6 and positive without offsets, of one tetrahedron; offsets (..., 4, 3)."""
    p = np.array([corner_position(c) for c in TETS[tet]]) + offsets
    rest = np.array([corner_position(c) for c in TETS[tet]])
    sign = np.linalg.det(rest[1:] - rest[:-1])
    return sign * np.linalg.det(p[..., 1:, :] - p[..., :-1, :])


@pytest.mark.parametrize("tet", range(6))
def test_no_offset_inverts_a_tetrahedron(tet):
    # The volume is linear in each coordinate of each vertex, so the worst case is a corner of the box.
    corners = np.array(list(itertools.product([-1, 1], repeat=12))).reshape(-1, 4, 3)
    assert _volumes(corners / 6, tet).min() == pytest.approx(0, abs=1e-12)
    assert _volumes(corners * MAX_OFFSET_CELLS, tet).min() == pytest.approx(0.1)


def test_points_follow_the_backend():
    import drjit.llvm.ad as llvm

    assert type(TetLattice(2).points(llvm.Float)) is llvm.Array3f
    assert dr.width(TetLattice(2).points(mi.Float)) == 27
