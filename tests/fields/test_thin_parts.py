"""Sheets that a lattice would miss are grown until it holds them; the rest stays as it is."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from gshell_mi import TetLattice, extract
from gshell_mi.fields.thin_parts import back_on_solid, thickened

CELLS, REFINEMENT = 16, 3


def fine_points() -> np.ndarray:
    """(x, y, z) in coarse cells around the centre, indexed [z, y, x]."""
    axis = np.arange(REFINEMENT * CELLS + 1) / REFINEMENT - CELLS / 2
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    return np.stack([x, y, z])


def disc(half: float, height: float) -> np.ndarray:
    """A round plate of radius 5."""
    x, y, z = fine_points()
    return np.maximum(np.abs(z - height) - half, np.hypot(x, y) - 5)


def at_vertices(sdf: np.ndarray) -> np.ndarray:
    return sdf[::REFINEMENT, ::REFINEMENT, ::REFINEMENT]


def template(sdf: np.ndarray):
    lattice = TetLattice(CELLS)
    flat = mi.Float((at_vertices(sdf) * lattice.spacing).astype(np.float32).ravel())
    return extract(lattice, flat, dr.full(mi.Float, 1, lattice.vertex_count))


@pytest.mark.parametrize("half", [0.2, 0.3, 0.4])
@pytest.mark.parametrize("height", [0.0, 0.3, 0.5])
def test_a_plate_thinner_than_a_cell_becomes_one_piece(half, height):
    mesh = template(thickened(disc(half, height), REFINEMENT)).to_trimesh()
    assert mesh.body_count == 1 and mesh.is_watertight and mesh.euler_number == 2
    spacing = 2 / CELLS
    assert np.ptp(mesh.vertices[:, 0]) == pytest.approx(10 * spacing, abs=1.5 * spacing)
    assert np.ptp(mesh.vertices[:, 2]) < 2.2 * spacing


def test_without_it_the_lattice_misses_the_plate():
    assert (at_vertices(disc(0.2, 0.5)) > 0).all()


def test_what_is_thick_stays_as_it_is():
    ball = np.linalg.norm(fine_points(), axis=0) - 4
    np.testing.assert_array_equal(thickened(ball, REFINEMENT), ball)


def test_back_on_the_solid():
    grown = trimesh.creation.icosphere(subdivisions=3, radius=1.2)
    back = back_on_solid(np.array(grown.vertices), np.array(grown.faces), np.full(len(grown.vertices), 0.2))
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1.0, atol=1e-3)
    within = np.full(len(grown.vertices), -0.2)
    inside = back_on_solid(np.array(grown.vertices), np.array(grown.faces), within)
    np.testing.assert_array_equal(inside, grown.vertices)
