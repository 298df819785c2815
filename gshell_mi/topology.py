"""Counts that tell whether a mesh is what it should be: loops, components, manifoldness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

#: A boundary loop shorter than this fraction of the bounding box's diagonal is a pin-hole.
PINHOLE = 0.05

#: Lobes are parted where they are at most twice this many vertices wide.
_NECK = 2


@dataclass(frozen=True)
class Topology:
    """Counts of a triangle mesh; lengths in the units of its vertices."""

    vertices: int
    faces: int
    components: int
    boundary_loops: int
    """Closed boundary curves, pin-holes not counted."""
    pinholes: int
    """Boundary curves shorter than 5 % of the bounding box's diagonal."""
    boundary_length: float
    nonmanifold_edges: int
    """Edges of more than two faces."""


def topology(vertices: np.ndarray, faces: np.ndarray) -> Topology:
    """Counts of the mesh with (V, 3) ``vertices`` and (F, 3) ``faces``.

    >>> square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    >>> found = topology(square, np.array([[0, 1, 2], [0, 2, 3]]))
    >>> found.boundary_loops, found.components, found.boundary_length
    (1, 1, 4.0)
    """
    if len(faces) == 0:
        return Topology(len(vertices), 0, 0, 0, 0, 0.0, 0)
    edges, uses = mesh_edges(faces)
    boundary = edges[uses == 1]
    lengths = np.linalg.norm(vertices[boundary[:, 0]] - vertices[boundary[:, 1]], axis=1)
    loops = np.bincount(curve_ids(boundary), lengths)
    used = np.unique(faces)
    diagonal = np.linalg.norm(np.ptp(vertices[used], axis=0))
    pinholes = int((loops <= PINHOLE * diagonal).sum())
    component = vertex_components(edges, len(vertices))[1]
    return Topology(
        vertices=len(vertices),
        faces=len(faces),
        components=len(np.unique(component[used])),
        boundary_loops=len(loops) - pinholes,
        pinholes=pinholes,
        boundary_length=round(float(lengths.sum()), 6),
        nonmanifold_edges=int((uses > 2).sum()),
    )


def boundary_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(B, 2) edges of one face each, and the boundary curve that each is on, numbered from 0.

    >>> boundary_edges(np.array([[0, 1, 2], [3, 4, 5]]))[1].tolist()
    [0, 0, 0, 1, 1, 1]
    """
    edges, uses = mesh_edges(faces)
    boundary = edges[uses == 1]
    return boundary, curve_ids(boundary)


def curve_ids(edges: np.ndarray) -> np.ndarray:
    """(E,) ids, from 0, of the connected curves that edges make up."""
    label = vertex_components(edges, int(edges.max(initial=-1)) + 1)[1]
    return np.unique(label[edges[:, 0]], return_inverse=True)[1]


def mesh_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(E, 2) edges of a mesh, the lower vertex first, in ascending order, and the number of faces of each."""
    corner, following = faces.astype(np.int64), np.roll(faces, -1, axis=1).astype(np.int64)
    low, high = np.minimum(corner, following).ravel(), np.maximum(corner, following).ravel()
    # One number per edge is sorted several times as fast as a pair.
    stride = int(high.max(initial=0)) + 1
    edges, uses = np.unique(low * stride + high, return_counts=True)
    return np.stack([edges // stride, edges % stride], axis=1), uses


def vertex_components(edges: np.ndarray, vertex_count: int) -> tuple[int, np.ndarray]:
    """Number of connected components of the graph with (E, 2) ``edges``, and each vertex's component."""
    weights = np.ones(len(edges), np.int8)
    graph = coo_matrix((weights, (edges[:, 0], edges[:, 1])), shape=(vertex_count, vertex_count))
    return connected_components(graph, directed=False)


def spread(chosen: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(V,) vertices that are chosen (V,) or joined to such a one by one of the (E, 2) edges.

    >>> spread(np.array([True, False, False]), np.array([[0, 1], [1, 2]])).tolist()
    [True, True, False]
    """
    result = chosen.copy()
    for here, there in (edges.T, edges.T[::-1]):
        result[here[chosen[there]]] = True
    return result


def mesh_components(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """(V,) ids of the connected components of a mesh with (F, 3) faces.

    >>> mesh_components(np.array([[0, 1, 2], [3, 4, 5]]), 6).tolist()
    [0, 0, 0, 1, 1, 1]
    """
    return vertex_components(mesh_edges(faces)[0], vertex_count)[1]


def patch_sizes(patch: np.ndarray, whole: np.ndarray, counted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How many of the (V,) ``counted`` vertices are in each vertex's patch, and in the largest beside it.

    Args:
        patch: (V,) ids of patches.
        whole: (V,) ids of what falls into patches; those beside each other are in one.

    >>> own, largest = patch_sizes(np.array([0, 0, 1, 2]), np.array([0, 0, 0, 1]), np.ones(4))
    >>> own.tolist(), largest.tolist()
    ([2.0, 2.0, 1.0, 1.0], [2.0, 2.0, 2.0, 1.0])
    """
    own = np.bincount(patch, counted)[patch]
    largest = np.zeros(whole.max(initial=-1) + 1)
    np.maximum.at(largest, whole, own)
    return own, largest[whole]


def equal_patches(labels: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) ids of the connected patches of vertices with equal (V,) labels, on a mesh with (F, 3) faces."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    same = labels[edges[:, 0]] == labels[edges[:, 1]]
    return vertex_components(edges[same], len(labels))[1]


def inner(chosen: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) which ``chosen`` vertices have only such neighbours.

    >>> inner(np.array([False, True, True, True]), np.array([[0, 1, 2], [1, 3, 2]])).tolist()
    [False, False, False, True]
    """
    return ~spread(~chosen, mesh_edges(faces)[0])


def lobes(chosen: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) ids of the connected patches of chosen and of other vertices, those that are chosen split at their
    necks."""
    edges, _ = mesh_edges(faces)
    here, there = np.concatenate([edges, edges[:, ::-1]]).T
    core = chosen
    for _ in range(_NECK):
        core = ~spread(~core, edges)
    patch = equal_patches(chosen, faces)
    # Patches without a core are whole.
    core = core | chosen & (np.bincount(patch, core) == 0)[patch]
    lobe = np.where(core, 1 + vertex_components(edges[core[edges].all(axis=1)], len(chosen))[1], 0)
    while True:
        front = (lobe[here] == 0) & (lobe[there] > 0) & chosen[here]
        if not front.any():
            break
        np.maximum.at(lobe, here[front], lobe[there[front]])
    return np.where(chosen, lobe, 1 + len(chosen) + patch)
