"""A flat square with holes along one rim."""

import numpy as np
from topology import loop_count

from gshell_mi.conversion.necks import necks
from gshell_mi.topology import equal_patches, mesh_edges

SIDE = 21


def square():
    """Vertices one apart, faces, and each vertex's column and row."""
    y, x = (a.ravel() for a in np.mgrid[:SIDE, :SIDE])
    low = np.flatnonzero((x < SIDE - 1) & (y < SIDE - 1))
    faces = np.concatenate(
        [
            np.stack([low, low + 1, low + SIDE + 1], axis=1),
            np.stack([low, low + SIDE + 1, low + SIDE], axis=1),
        ]
    )
    return np.stack([x, y, 0 * x], axis=1).astype(float), faces, x, y


def loops(faces, positive):
    """Of the part of the square whose vertices are positive, its own outline among them."""
    return loop_count(faces[positive[faces].all(axis=1)])


def found(vertices, faces, positive, rim, reach):
    """The necks; the border runs through the middles of the edges between vertices of both signs."""
    edges, _ = mesh_edges(faces)
    crossed = edges[positive[edges[:, 0]] != positive[edges[:, 1]]]
    outside = np.where(positive[crossed[:, 0]], crossed[:, 1], crossed[:, 0])
    loop = np.unique(equal_patches(positive, faces)[outside], return_inverse=True)[1]
    return necks(vertices, edges, positive, vertices[crossed].mean(axis=1), loop, rim[outside], reach)


def holes(x, y, at, radius=2):
    return np.any([np.maximum(abs(x - a), abs(y - b)) <= radius for a, b in at], axis=0)


def test_holes_of_one_rim_become_one():
    vertices, faces, x, y = square()
    positive = ~holes(x, y, [(5, 5), (12, 5), (12, 12)])
    assert loops(faces, positive) == 4
    cut = found(vertices, faces, positive, np.zeros(len(vertices), int), 4.0)
    assert positive[cut].all()
    # Two walls, each two vertices thick and crossed straight or along a diagonal.
    assert len(cut) == 4
    positive[cut] = False
    assert loops(faces, positive) == 2
    assert len(found(vertices, faces, positive, np.zeros(len(vertices), int), 4.0)) == 0


def test_a_wall_of_one_vertex():
    vertices, faces, x, y = square()
    positive = ~holes(x, y, [(5, 5), (11, 5)])
    cut = found(vertices, faces, positive, np.zeros(len(vertices), int), 4.0)
    assert len(cut) == 1 and x[cut] == 8 and 3 <= y[cut] <= 7


def test_rims_stay_apart():
    vertices, faces, x, y = square()
    positive = ~holes(x, y, [(5, 5), (12, 5)])
    assert len(found(vertices, faces, positive, (x > 8).astype(int), 4.0)) == 0
    assert len(found(vertices, faces, positive, np.zeros(len(vertices), int), 1.0)) == 0, "a thicker wall"
    assert len(found(vertices, faces, np.ones(len(vertices), bool), np.zeros(len(vertices), int), 4.0)) == 0
