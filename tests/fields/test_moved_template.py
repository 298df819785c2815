"""Fields carried along a displacement, against closed forms."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.fields import sphere
from gshell_mi.fields.moved_template import advect
from gshell_mi.lattice import TetLattice

LATTICE = TetLattice(32)


def displacement(function) -> mi.Float:
    return dr.ravel(mi.Vector3f(function(mi.Point3f(LATTICE.points(mi.Float)))))


def test_no_displacement_changes_nothing():
    field = mi.Float(np.random.default_rng(0).normal(size=LATTICE.vertex_count).astype(np.float32))
    assert np.allclose(advect(field, displacement(lambda p: mi.Vector3f(0 * p)), LATTICE), field, atol=1e-5)


def test_translation_by_whole_cells_is_a_shift():
    field = np.random.default_rng(1).normal(size=(33, 33, 33)).astype(np.float32)
    cell = LATTICE.spacing
    moved = advect(mi.Float(field.ravel()),
                   displacement(lambda p: mi.Vector3f(2 * cell, 0 * p.y, -cell)), LATTICE)
    moved = moved.numpy().reshape(33, 33, 33)
    assert np.allclose(moved[:-1, :, 2:], field[1:, :, :-2], atol=1e-4)


def test_scaling_inverts_the_displacement():
    """Points go to 1.3 p, so the sphere of radius 0.4 becomes the one of radius 0.52."""
    sdf = mi.Float(sphere(LATTICE, radius=0.4).sdf)
    moved = advect(sdf, displacement(lambda p: mi.Vector3f(0.3 * p)), LATTICE).numpy()
    exact = np.linalg.norm(LATTICE.vertex_positions(), axis=1) - 0.52
    near = np.abs(exact) < 2 * LATTICE.spacing
    assert np.abs(moved[near] * 1.3 - exact[near]).max() < 0.1 * LATTICE.spacing


@pytest.mark.parametrize("channels", [1, 3])
def test_channels(channels):
    rng = np.random.default_rng(2)
    field = rng.normal(size=(LATTICE.vertex_count, channels)).astype(np.float32)
    offset = mi.Float(rng.uniform(-0.02, 0.02, 3 * LATTICE.vertex_count).astype(np.float32))
    together = advect(mi.Float(field.ravel()), offset, LATTICE).numpy().reshape(-1, channels)
    for channel in range(channels):
        alone = advect(mi.Float(np.ascontiguousarray(field[:, channel])), offset, LATTICE)
        assert np.allclose(together[:, channel], alone, atol=1e-6)
