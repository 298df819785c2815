"""Remeshing: boundary, shape and quality."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from fitted import RADIUS, open_sphere
from topology import loop_count

from gshell_mi import TetLattice, UserError, extract
from gshell_mi.export.remesh import edge_length_for, remesh, triangle_quality
from gshell_mi.topology import topology


def boundary_edges(vertices, faces) -> set:
    edges, uses = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0, return_counts=True)
    return {tuple(sorted(map(tuple, vertices[edge].round(6).tolist()))) for edge in edges[uses == 1]}


def ragged_sphere():
    """An open sphere as it is extracted, with slivers along the isosurface and the rim."""
    lattice = TetLattice(24)
    points = lattice.points(mi.Float)
    mesh = extract(lattice, dr.norm(points) - RADIUS, 0.31 - points.y + 0.1 * points.x)
    vertices, faces, _ = mesh.to_numpy()
    return vertices.astype(float), faces


def test_quality_of_known_triangles():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0], [2, 0, 0]])
    found = triangle_quality(corners, np.array([[0, 1, 2], [0, 1, 3], [0, 0, 0]]))
    np.testing.assert_allclose(found, [1, 0, 0], atol=1e-12)


def test_boundary_stays_edge_by_edge():
    vertices, faces = ragged_sphere()
    v, f = remesh(vertices, faces, edge_length_for(vertices, faces, 1500))
    assert boundary_edges(v, f) == boundary_edges(vertices, faces)
    assert 1000 < len(f) < 2000 < len(faces)
    assert loop_count(f) == 1
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), RADIUS, atol=0.01)


@pytest.mark.parametrize("min_quality", [0.3, 0.5])
def test_no_slivers(min_quality):
    vertices, faces = ragged_sphere()
    assert triangle_quality(vertices, faces).min() < 0.1
    length = edge_length_for(vertices, faces, 1500)
    v, f = remesh(vertices, faces, length, resample_boundary=True, min_quality=min_quality)
    assert triangle_quality(v, f).min() >= min_quality
    before, after = topology(vertices, faces), topology(v, f)
    assert (after.boundary_loops, after.components, after.nonmanifold_edges) == (1, 1, 0)
    assert after.boundary_length == pytest.approx(before.boundary_length, rel=0.03)
    assert trimesh.Trimesh(v, f, process=False).is_winding_consistent
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), RADIUS, atol=0.02)


@pytest.mark.parametrize("length", [0.0, -1.0, 5.0, float("nan")])
def test_unsuitable_length(length):
    mesh = open_sphere(2)
    with pytest.raises(UserError, match="does not suit an object of size"):
        remesh(mesh.vertices, mesh.faces, length)


def test_quality_out_of_reach():
    mesh = open_sphere(2)
    with pytest.raises(UserError, match="try another edge length or a lower quality"):
        remesh(mesh.vertices, mesh.faces, 0.2, resample_boundary=True, min_quality=0.999)


def test_more_triangles_than_memory_holds():
    mesh = open_sphere(2)
    with pytest.raises(
        UserError, match=r"some [\d,]+ triangles, needs about .+; the object's size is .+ longer edge"
    ):
        remesh(mesh.vertices, mesh.faces, 1e-6)
