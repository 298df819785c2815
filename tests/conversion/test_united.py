"""Closed parts that overlap or lie in one another become one solid."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from gshell_mi.conversion import from_mesh
from gshell_mi.conversion.united import visible_part
from gshell_mi.errors import UserError
from gshell_mi.extraction import extract
from gshell_mi.lattice import TetLattice, make_lattice
from gshell_mi.topology import topology

BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.4)


def at(x, radius=1.0):
    ball = BALL.copy()
    ball.apply_scale(radius)
    ball.apply_translation([x, 0, 0])
    return ball


def surface(mesh, grid="tet", resolution=32):
    lattice = make_lattice(grid, resolution)
    fields = from_mesh(mesh, lattice)
    vertices, faces, _ = extract(lattice, mi.Float(fields.sdf), mi.Float(fields.msdf)).to_numpy()
    return trimesh.Trimesh(vertices.astype(float), faces, process=False), lattice.spacing


@pytest.mark.parametrize("grid", ["tet", "flexicubes"])
def test_overlapping_balls_are_their_union(grid):
    """Of two balls of radius r at a distance d, each loses a cap of height r - d / 2."""
    found, cell = surface(trimesh.util.concatenate([at(-0.2), at(0.2)]), grid)
    r, cap = 0.4, 0.2
    assert found.area == pytest.approx(2 * (4 * np.pi * r**2 - 2 * np.pi * r * cap), rel=0.02)
    volume = 4 / 3 * np.pi * r**3 - np.pi * cap**2 * (3 * r - cap) / 3
    assert found.volume == pytest.approx(2 * volume, rel=0.03)
    assert topology(found.vertices, found.faces).components == 1
    off = np.minimum(*(np.abs(np.linalg.norm(found.vertices - [x, 0, 0], axis=1) - r) for x in (-0.2, 0.2)))
    assert off.max() < 0.5 * cell


def test_a_ball_in_a_ball_is_not_seen():
    found, cell = surface(trimesh.util.concatenate([at(0, 1.5), at(0.05)]))
    assert np.abs(np.linalg.norm(found.vertices, axis=1) - 0.6).max() < 0.5 * cell


def test_a_rod_through_a_ball():
    rod = trimesh.creation.box([1.6, 0.2, 0.2])
    found, cell = surface(trimesh.util.concatenate([at(0), rod]))
    points, _ = trimesh.sample.sample_surface(trimesh.util.concatenate([at(0), rod]), 100_000, seed=0)
    assert cKDTree(points).query(found.vertices)[0].max() < cell
    assert topology(found.vertices, found.faces).components == 1


def test_what_is_visible_of_two_balls():
    found = visible_part(trimesh.util.concatenate([at(-0.2), at(0.2)]), 0.05)
    assert found.area == pytest.approx(2 * (4 * np.pi * 0.16 - 2 * np.pi * 0.4 * 0.2), rel=0.01)


def test_what_falls_between_the_vertices_is_refused():
    crumb = BALL.copy()
    crumb.apply_scale(0.01)
    crumb.apply_translation([0.06, 0.05, 0.04])
    with pytest.raises(UserError, match="leaves no surface on a lattice"):
        from_mesh(crumb, TetLattice(8))
