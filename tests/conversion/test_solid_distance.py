"""Signed distances to closed meshes: a sphere, meshes that intersect, a plate with an open side."""

import numpy as np
import trimesh

from gshell_mi import TetLattice
from gshell_mi.conversion.solid_distance import solid_distance

LATTICE = TetLattice(24)


def points() -> np.ndarray:
    return LATTICE.vertex_positions().astype(float)


def distance(mesh: trimesh.Trimesh, solid: np.ndarray | None = None) -> np.ndarray:
    solid = np.ones(len(mesh.vertices), bool) if solid is None else solid
    return solid_distance(np.array(mesh.vertices), np.array(mesh.faces), solid, LATTICE)


def inner() -> np.ndarray:
    """Lattice vertices off the cube's faces, where the field is forced to be outside."""
    return (np.abs(points()) < 0.99).all(axis=1)


def test_sphere():
    exact = np.linalg.norm(points(), axis=1) - 0.6
    found = distance(trimesh.creation.icosphere(subdivisions=4, radius=0.6))
    near = np.abs(exact) < 2 * LATTICE.spacing
    np.testing.assert_allclose(found[near], exact[near], atol=2e-3)
    clear = np.abs(exact) > 2e-3
    assert (np.sign(found) == np.sign(exact))[clear & inner()].all()


def test_meshes_that_intersect_are_united():
    centres = np.array([[-0.2, 0, 0], [0.2, 0.1, 0]])
    balls = [trimesh.creation.icosphere(subdivisions=4, radius=0.4).apply_translation(c) for c in centres]
    exact = np.min([np.linalg.norm(points() - c, axis=1) for c in centres], axis=0) - 0.4
    found = distance(trimesh.util.concatenate(balls))
    clear = np.abs(exact) > 5e-3
    assert (np.sign(found) == np.sign(exact))[clear & inner()].all()


def test_in_a_thin_plate_the_solid_side_counts():
    cell = LATTICE.spacing
    top, bottom = 0.5 * cell, -0.7 * cell  # the lattice's vertices at z = 0 are nearer to the top
    plate = trimesh.creation.box(bounds=[[-0.7, -0.7, bottom], [0.7, 0.7, top]])
    for _ in range(4):
        plate = plate.subdivide()
    middle = (np.abs(points()[:, 2]) < 1e-6) & (np.abs(points()[:, :2]) < 0.5).all(axis=1)
    lower = plate.vertices[:, 2] > bottom + 1e-6
    np.testing.assert_allclose(distance(plate, lower)[middle], -0.5 * cell, rtol=1e-3)
    upper = plate.vertices[:, 2] < top - 1e-6
    np.testing.assert_allclose(distance(plate, upper)[middle], -0.7 * cell, rtol=1e-3)
