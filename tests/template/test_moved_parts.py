"""A signed distance follows what has moved of its surface, and nothing else changes."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from gshell_mi.extraction import extract
from gshell_mi.lattice import TetLattice
from gshell_mi.template.caps import Recesses, least_bent
from gshell_mi.template.moved_parts import with_moved_parts
from gshell_mi.topology import topology

RADIUS = 0.6


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_a_bulge_goes(scale):
    """World units are another than the lattice's; the surface elsewhere is the same bit for bit."""
    lattice = TetLattice(32)
    points = lattice.vertex_positions()
    pole = np.array([0, 0, RADIUS])
    bulge = np.linalg.norm(points - pole, axis=1) - 3 * lattice.spacing
    sdf = np.minimum(np.linalg.norm(points, axis=1) - RADIUS, bulge) / lattice.spacing
    vertices, faces, _ = extract(lattice, mi.Float(sdf.astype(np.float32))).to_numpy()
    caps = np.linalg.norm(vertices - pole, axis=1) < 3.5 * lattice.spacing
    moved = least_bent(scale * vertices, faces, caps)
    smooth, told = with_moved_parts(
        sdf, scale * points, scale * vertices, moved, faces, scale * lattice.spacing
    )
    found = extract(lattice, mi.Float(smooth.astype(np.float32))).to_numpy()[0]
    before, after = (np.linalg.norm(at, axis=1).max() - RADIUS for at in (vertices, found))
    assert before > 2.8 * lattice.spacing and after < 0.7 * lattice.spacing
    far = np.linalg.norm(points - pole, axis=1) > 9 * lattice.spacing
    np.testing.assert_array_equal(smooth[far], sdf[far])
    assert not told[far].any() and told[np.linalg.norm(points - pole, axis=1) < lattice.spacing].all()


def test_a_recess_comes_out_as_deep_as_it_is_meant():
    """Its walls are steep: one triangle from top to bottom."""
    lattice = TetLattice(48)
    points, cell = lattice.vertex_positions(), lattice.spacing
    sdf = (np.linalg.norm(points, axis=1) - RADIUS) / cell
    vertices, faces, _ = extract(lattice, mi.Float(sdf.astype(np.float32))).to_numpy()
    place = np.where(vertices[:, 2] > 0.9 * RADIUS, 0, -1)
    deep = 7 * cell
    moved = Recesses(vertices, faces, place).at(deep)
    sunk, _ = with_moved_parts(sdf, points, vertices, moved, faces, cell)
    found, triangles, _ = extract(lattice, mi.Float(sunk.astype(np.float32))).to_numpy()
    column = found[(np.hypot(found[:, 0], found[:, 1]) < cell) & (found[:, 2] > 0)]
    np.testing.assert_allclose(column[:, 2], RADIUS - deep, atol=0.2 * cell)
    told = topology(found, triangles)
    assert (told.boundary_loops, told.components) == (0, 1)
    assert trimesh.Trimesh(found, triangles, process=False).euler_number == 2
    assert np.linalg.norm(found, axis=1).max() < RADIUS + 0.1 * cell


def test_two_recesses_that_meet_are_empty_where_either_is():
    """At right angles, each up to the middle of a box."""
    lattice, half = TetLattice(40), 0.6
    points, cell = lattice.vertex_positions(), lattice.spacing
    sdf = (np.abs(points).max(axis=1) - half) / cell
    vertices, faces, _ = extract(lattice, mi.Float(sdf.astype(np.float32))).to_numpy()
    within = np.abs(vertices) < 0.7 * half
    place = np.full(len(vertices), -1)
    for axis in (0, 2):
        place[np.delete(within, axis, axis=1).all(axis=1) & (vertices[:, axis] > half - cell)] = axis // 2
    carved = []
    for depths in ([9, 0], [0, 9], [9, 9]):
        moved = Recesses(vertices, faces, place).at(np.array(depths) * cell)
        carved.append((sdf < 0) & (with_moved_parts(sdf, points, vertices, moved, faces, cell)[0] >= 0))
    one, other, both = carved
    assert (one & other).sum() > 100
    np.testing.assert_array_equal(both, one | other)
