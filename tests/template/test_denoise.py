"""Denoising takes from a surface the bumps that its error allows, and nothing else."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.extraction import extract
from gshell_mi.lattice import GRIDS, make_lattice
from gshell_mi.template.denoise import denoised

ERROR = 0.4


def _box(lattice, half):
    """Distance to a box, in the lattice's units."""
    x, y, z = lattice.points(mi.Float)
    away = dr.abs(x) - half[0], dr.abs(y) - half[1], dr.abs(z) - half[2]
    outside = dr.norm(mi.Vector3f(*(dr.maximum(value, 0) for value in away)))
    return (outside + dr.minimum(dr.maximum(dr.maximum(away[0], away[1]), away[2]), 0)).numpy()


def _bumpy(sdf, lattice):
    """With bumps a few cells wide."""
    points = lattice.points(mi.Float).numpy() / lattice.spacing
    waves = np.sin(1.6 * points + np.array([[0.3], [1.1], [2.0]])).prod(axis=0)
    return (sdf + ERROR * lattice.spacing * waves / np.abs(waves).max()).astype(np.float32)


def _mesh(sdf, lattice):
    return extract(lattice, mi.Float(sdf)).to_trimesh()


@pytest.mark.parametrize("grid", GRIDS)
def test_sides_become_flat_and_edges_stay(grid):
    lattice = make_lattice(grid, 32)
    half = np.array([0.53, 0.41, 0.61])
    truth = _box(lattice, half)
    rough = _bumpy(truth, lattice)
    smooth = denoised(rough, lattice, ERROR)
    before, after = _mesh(rough, lattice), _mesh(smooth, lattice)
    # Half of a box is beside no edge.
    tilt = [
        np.degrees(np.median(np.arccos(np.abs(mesh.face_normals).max(axis=1)))) for mesh in (before, after)
    ]
    assert tilt[1] < 0.5 * tilt[0], tilt
    off = [np.median(np.abs(np.max(np.abs(mesh.vertices) - half, axis=1))) for mesh in (before, after)]
    assert off[1] < 0.95 * off[0], off
    # The edges are no rounder than noise has made them: as far out as a box of this lattice is.
    assert np.abs(after.bounds).min(axis=0) == pytest.approx(half, abs=ERROR * lattice.spacing)


def test_nothing_moves_by_more_than_the_error():
    lattice = make_lattice("tet", 24)
    rough = _bumpy(_box(lattice, (0.5, 0.5, 0.5)), lattice)
    moved = np.abs(denoised(rough, lattice, ERROR) - rough) / lattice.spacing
    assert 0.1 < moved.max() <= ERROR + 1e-5
    assert moved[np.abs(rough) > 3 * lattice.spacing].max() < 1e-5


def test_thin_sheets_stay_whole():
    """One that is a little thicker than twice the error; a kernel as wide would tear it."""
    lattice = make_lattice("tet", 32)
    thin = _bumpy(_box(lattice, (0.6, 1.1 * lattice.spacing, 0.6)), lattice)
    mesh = _mesh(denoised(thin, lattice, ERROR), lattice)
    assert mesh.is_watertight and mesh.body_count == 1 and mesh.euler_number == 2


def test_what_vanishes_is_no_mistake():
    lattice = make_lattice("tet", 16)
    speck = _box(lattice, (0, 0, 0)) - 0.2 * lattice.spacing
    assert (denoised(speck, lattice, 1.0) < 0).sum() <= 1
