"""Lunes of silhouette directions around edges, and sampling from lists."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.integrators.edge_table import scene_edge_tables
from gshell_mi.integrators.edge_wedges import build_edge_wedges, silhouette_for
from gshell_mi.integrators.resampling import low_discrepancy, systematic_counts
from gshell_mi.integrators.shadow_edges import draw_directions
from pipelines import gradient_scenes as scenes


def wedges_of(*meshes):
    others = {f"mesh{k}": mesh for k, mesh in enumerate(meshes[1:])}
    scene = scenes.load(scenes.camera(8), scenes.constant(), meshes[0], **others)
    return scene, scene_edge_tables(scene), build_edge_wedges(scene_edge_tables(scene))


def test_lunes_of_a_cube_are_right_angles_and_flat_edges_have_none():
    box = scenes.box_without_top()
    _, _, wedges = wedges_of(scenes.make_mesh("subject", *box, smooth=False))
    opening = np.array(wedges.opening())
    # Eight edges between faces, four open ones; the five diagonals are flat.
    assert np.sum(np.abs(opening - np.pi / 2) < 1e-4) == 8
    assert np.sum(np.abs(opening - np.pi) < 1e-4) == 4
    assert len(opening) == 12


def silhouettes(v, f, direction):
    """End points of the edges all of whose faces lie on one side of a direction's line, by brute force."""
    v, found = np.asarray(v, float), {}
    for face in f:
        for k in range(3):
            i, j, opposite = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
            i, j = min(i, j), max(i, j)
            side = np.dot(np.cross(v[j] - v[i], direction), v[opposite] - v[i]) > 0
            found.setdefault((i, j), []).append(side)
    return [edge for edge, sides in found.items() if len(set(sides)) == 1]


@pytest.mark.parametrize("mesh", [scenes.sphere(2), scenes.open_cylinder(12, 3), scenes.sheet(3)])
def test_silhouettes_for_a_direction(mesh):
    v, f = mesh
    _, _, wedges = wedges_of(scenes.make_mesh("subject", v, f))
    direction = np.array([0.36, 0.47, 0.81])
    _, _, _, inward, across = wedges.frame(dr.arange(mi.UInt32, dr.width(wedges.start)))
    found = silhouette_for(mi.Vector3f(direction), inward, across, wedges.low, wedges.high)
    assert dr.count(found)[0] == len(silhouettes(v, f, direction)) > 5


def test_three_sheets_at_one_edge():
    """An edge of three faces is a silhouette where all of them lie on one side."""
    v = [[0, 0, -1], [0, 0, 1], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    f = [[0, 1, 2], [0, 1, 3], [1, 0, 4]]
    _, _, wedges = wedges_of(scenes.make_mesh("subject", v, f, smooth=False))
    opening = np.sort(np.array(wedges.opening()))
    assert opening[0] == pytest.approx(np.pi / 2, abs=1e-4) and len(opening) == 7


def test_drawn_directions_are_silhouettes_and_weights_make_up_the_mean_apparent_outline():
    """Cauchy: the mean outline of a convex body over all directions is known by its edges alone."""
    scene, _, wedges = wedges_of(scenes.make_mesh("subject", *scenes.sphere(2)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, 8)
    drawn = draw_directions(scene, wedges, 4000, sampler.next_1d())
    p, q, axis, inward, across = wedges.frame(drawn.edge)
    low, high = dr.gather(mi.Float, wedges.low, drawn.edge), dr.gather(mi.Float, wedges.high, drawn.edge)
    assert dr.all(silhouette_for(drawn.position, inward, across, low, high))
    apparent = dr.norm(q - p) * dr.norm(dr.cross(axis, drawn.position))
    mean = dr.sum(apparent * drawn.weight)[0] / (4 * np.pi)
    # The outline of the unit sphere has length 2 pi; that of a polyhedron is a zigzag and longer.
    assert mean == pytest.approx(2 * np.pi, rel=0.1)
    v, f = scenes.sphere(2)
    lengths = []
    for z in np.random.default_rng(0).normal(size=(20, 3)):
        z /= np.linalg.norm(z)
        edges = np.array(silhouettes(v, f, z))
        lengths.append(np.linalg.norm(np.cross(v[edges[:, 1]] - v[edges[:, 0]], z), axis=1).sum())
    assert mean == pytest.approx(np.mean(lengths), rel=0.02)


def test_systematic_counts_are_proportional_and_unbiased():
    importance = mi.Float(np.random.default_rng(0).uniform(0.5, 1, 50).astype(np.float32))
    total = 0
    for offset in (np.arange(100) + 0.5) / 100:
        count, weight = systematic_counts(importance, 30, mi.Float(offset))
        assert dr.sum(count)[0] == pytest.approx(30, abs=1)
        total += np.array(mi.Float(count) * weight)
    np.testing.assert_allclose(total / 100, 1, atol=0.03)


def test_nothing_to_draw():
    assert systematic_counts(mi.Float(0, 0, dr.nan), 10, mi.Float(0.5)) is None


def test_low_discrepancy_numbers_fill_the_interval_evenly():
    shifts = mi.Float(np.linspace(0, 0.9, 8))
    for dimension in range(7):
        x = np.sort(np.array(low_discrepancy(dr.arange(mi.UInt32, 1000), dimension, shifts)))
        assert np.abs(x - (np.arange(1000) + 0.5) / 1000).max() < 0.01
