"""How openings grow along a template without any two of them meeting."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra

from ..topology import equal_patches, mesh_edges, spread

#: Gaps of up to twice so many edges are grown over.
_GAP = 1

#: Vertices between openings that would meet, on either side of where they would.
_WALL = 2

#: Fewest vertices that an opening grows by in one place: less is the rim's own matter.
_FEWEST = 12


def grown_apart(solid: np.ndarray, empty: np.ndarray, order: np.ndarray, vertices: np.ndarray,
                faces: np.ndarray, reach: float) -> np.ndarray:
    """(V,) vertices by which openings grow into what is empty, without any two of them meeting.

    Args:
        solid: (V,) False in openings.
        empty: (V,) where they may grow; small gaps in it are closed.
        order: (V,) vertices with lower values go first.
        vertices, faces: (V, 3) and (F, 3) of the watertight template.
        reach: the longest way along the template between an opening and what opens apart from it, in the
            unit of the vertices.
    """
    edges, _ = mesh_edges(faces)
    reached = ~solid | empty
    for _ in range(_GAP):
        reached = spread(reached, edges)
    for _ in range(_GAP):
        reached = ~spread(~reached, edges)
    # Around an island an opening would meet itself; what is smaller than a place that grows does not stay.
    patch = equal_patches(reached, faces)
    reached |= np.bincount(patch)[patch] < _FEWEST
    opened = ~solid
    apart = reached & ~spread(grown(opened, reached, order, faces), edges)
    opened[_seeds(apart, order, _distances(_ways(vertices, faces), opened, reach)[0], faces)] = True
    blocked = reached & ~grown(opened, reached, order, faces)
    # A rim moves: what parts two rims has to be wide enough to outlast that.
    for _ in range(_WALL):
        blocked = spread(blocked, edges)
    added = grown(opened, reached & ~blocked, order, faces) & solid
    patch = equal_patches(added, faces)
    return added & (np.bincount(patch)[patch] >= _FEWEST)


def joined(openings: np.ndarray, apart: np.ndarray, vertices: np.ndarray, faces: np.ndarray,
           reach: float) -> np.ndarray:
    """Openings with those that lie apart, and with the shortest ways along the template between them.

    At the neck of a pleat the two sides of the cloth may touch, and what is inside it then ends twice: there,
    and at its other end. Both ends are one opening in truth, and so is the way between them.

    Args:
        openings: (V,) what is joined to.
        apart: (V,) what is to be joined. Of less than a dozen connected vertices nothing is.
        vertices, faces: (V, 3) and (F, 3) of the watertight template.
        reach: the longest way, in the unit of the vertices.
    """
    openings, ways = openings.copy(), _ways(vertices, faces)
    patch = equal_patches(apart, faces)
    large = apart & (np.bincount(patch)[patch] >= _FEWEST)
    while (large & ~openings).any():
        distance, before = _distances(ways, openings, reach)
        distance[~large | openings] = np.inf
        here = int(np.argmin(distance))
        if not np.isfinite(distance[here]):
            break
        openings |= patch == patch[here]
        while before[here] >= 0:
            here = before[here]
            openings[here] = True
    return openings


def _ways(vertices: np.ndarray, faces: np.ndarray) -> csr_matrix:
    """(V, V) lengths of a mesh's edges."""
    start, end = mesh_edges(faces)[0].T
    length = np.linalg.norm(vertices[start] - vertices[end], axis=1)
    return coo_matrix((length, (start, end)), (len(vertices), len(vertices))).tocsr()


def _distances(ways: csr_matrix, openings: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """(V,) lengths of the shortest ways to an opening, infinite beyond ``reach``, and (V,) the next vertex on
    each, negative for none."""
    distance, before, _ = dijkstra(ways, directed=False, indices=np.flatnonzero(openings), limit=reach,
                                   min_only=True, return_predecessors=True)
    return distance, before


def _seeds(apart: np.ndarray, order: np.ndarray, distance: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of each large connected patch of ``apart`` (V,) that is within reach, the vertex that comes first."""
    patch = equal_patches(apart, faces)
    nearest = np.full(len(apart), np.inf)
    np.minimum.at(nearest, patch, distance)
    candidates = np.flatnonzero(apart & (np.bincount(patch)[patch] >= _FEWEST) & np.isfinite(nearest[patch]))
    candidates = candidates[np.argsort(order[candidates], kind="stable")]
    return candidates[np.unique(patch[candidates], return_index=True)[1]]


def grown(opened: np.ndarray, allowed: np.ndarray, order: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Openings grown as far as they may without parting a surface or an opening, or joining two of them.

    A vertex may go if its neighbours, in a ring around it, are one run of open ones and one run of others
    (a simple point of digital topology): all loops and handles of the surface stay then.

    Args:
        opened: (V,) the openings.
        allowed: (V,) where they may grow.
        order: (V,) vertices with lower values go first.
        faces: (F, 3) of the watertight template.

    Returns:
        (V,) the openings afterwards.

    >>> upper = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]]
    >>> lower = [[5, 2, 1], [5, 3, 2], [5, 4, 3], [5, 1, 4]]
    >>> number = np.arange(6)
    >>> grown(number == 0, number < 4, number, np.array(upper + lower)).astype(int).tolist()
    [1, 1, 1, 1, 0, 0]
    """
    opened = opened.copy()
    edges, _ = mesh_edges(faces)
    here, there = np.concatenate([edges, edges[:, ::-1]]).T
    rank = np.empty(len(order), int)
    rank[np.argsort(order, kind="stable")] = np.arange(len(order))
    while True:
        changes = np.zeros(len(opened), int)
        for corner in range(3):
            before, after = faces[:, (corner + 1) % 3], faces[:, (corner + 2) % 3]
            differ = opened[before] != opened[after]
            changes += np.bincount(faces[:, corner][differ], minlength=len(opened))
        simple = allowed & ~opened & (changes == 2)
        if not simple.any():
            return opened
        # Whether one may go depends on its neighbours, so of neighbours one goes at a time.
        first = np.full(len(opened), len(opened))
        np.minimum.at(first, here, np.where(simple, rank, len(opened))[there])
        opened |= simple & (rank < first)
