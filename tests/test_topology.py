"""Counts of meshes whose topology is known."""

import numpy as np
import pytest
import trimesh

from gshell_mi.topology import PINHOLE, Topology, topology, vertex_components


def strip(count: int, *, half_turns: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed band of ``count`` quads around the z axis, twisted by half turns."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    twist = 0.5 * half_turns * angle
    centre = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    across = 0.3 * (np.cos(twist)[:, None] * [0, 0, 1] + np.sin(twist)[:, None] * centre)
    vertices = np.stack([centre - across, centre + across], axis=1).reshape(-1, 3)
    faces = []
    for i in range(count):
        a, b = 2 * i, 2 * i + 1
        c, d = (2 * i + 2, 2 * i + 3) if i + 1 < count else ((1, 0) if half_turns % 2 else (0, 1))
        faces += [[a, c, b], [b, c, d]]
    return vertices, np.array(faces)


def test_sphere():
    sphere = trimesh.creation.icosphere(2)
    found = topology(sphere.vertices, sphere.faces)
    assert found == Topology(
        vertices=162,
        faces=320,
        components=1,
        boundary_loops=0,
        pinholes=0,
        boundary_length=0.0,
        nonmanifold_edges=0,
    )


def test_open_cylinder_has_two_loops():
    found = topology(*strip(24, half_turns=0))
    assert (found.components, found.boundary_loops, found.pinholes, found.nonmanifold_edges) == (1, 2, 0, 0)
    assert found.boundary_length == pytest.approx(2 * 24 * 2 * np.sin(np.pi / 24), rel=1e-5), "two 24-gons"


def test_moebius_strip_has_one_loop():
    found = topology(*strip(24, half_turns=1))
    assert (found.components, found.boundary_loops, found.nonmanifold_edges) == (1, 1, 0)


def test_two_components():
    one = trimesh.creation.icosphere(1)
    vertices, faces = strip(12, half_turns=0)
    faces = np.concatenate([one.faces, faces + len(one.vertices)])
    found = topology(np.concatenate([one.vertices, vertices + 5]), faces)
    assert (found.components, found.boundary_loops) == (2, 2)


def test_unreferenced_vertices_are_counted_as_vertices_only():
    sphere = trimesh.creation.icosphere(1)
    found = topology(np.concatenate([sphere.vertices, [[9, 9, 9]]]), sphere.faces)
    assert (found.vertices, found.components) == (len(sphere.vertices) + 1, 1)


@pytest.mark.parametrize(("share", "expected"), [(0.99, (0, 1)), (1.01, (1, 0))])
def test_a_pinhole_is_shorter_than_a_twentieth_of_the_diagonal(share, expected):
    """A tetrahedron without one face, in a box of diagonal 1; the boundary's length is near the threshold."""
    length = share * PINHOLE
    side = length / 3
    base = side * np.array([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0]])
    extent = np.ptp(base, axis=0)
    apex = [0, 0, np.sqrt(1 - extent @ extent)]
    found = topology(np.concatenate([base, [apex]]), np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    assert found.boundary_length == pytest.approx(length, abs=1e-6)
    assert (found.boundary_loops, found.pinholes) == expected


def test_nonmanifold_edge():
    """Three triangles on one edge, like the pages of a book."""
    vertices = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-1, 1, 0], [-1, -1, 0]], float)
    found = topology(vertices, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]))
    assert (found.nonmanifold_edges, found.components) == (1, 1)


def test_nothing():
    assert topology(np.zeros((0, 3)), np.zeros((0, 3), int)) == Topology(0, 0, 0, 0, 0, 0.0, 0)


def test_vertex_components():
    count, label = vertex_components(np.array([[0, 1], [1, 2], [3, 4]]), 6)
    assert count == 3
    assert label[0] == label[1] == label[2] and label[3] == label[4]
    assert len({label[0], label[3], label[5]}) == 3
