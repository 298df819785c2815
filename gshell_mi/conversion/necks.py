"""A rim of a mesh is one loop of the surface: the necks that tear it apart on a coarse lattice."""

import numpy as np
from scipy.cluster.hierarchy import DisjointSet
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree


def necks(
    vertices: np.ndarray,
    edges: np.ndarray,
    positive: np.ndarray,
    border: np.ndarray,
    loop: np.ndarray,
    rim: np.ndarray,
    reach: float,
) -> np.ndarray:
    """The vertices of a template that have to be cut, so that no rim of a mesh becomes several loops.

    Where two places of a rim are nearer to each other than the lattice can tell, the surface grows together
    between them, and what should be one loop falls into several along the same rim. The shortest ways over
    the surface from one to the other are the necks.

    Args:
        vertices: of the template, (n, 3).
        edges: of the template, (m, 2).
        positive: (n,) whether the vertex is on the surface.
        border: (k, 3) points where the surface ends.
        loop: (k,) the loop of the surface that each of these is on, from 0.
        rim: (k,) the rim of the mesh that is nearest to it, from 0.
        reach: necks are no longer than this.

    Returns:
        Indices of vertices on the surface; empty if every rim has one loop, or several that are farther
        from each other than ``reach``.
    """
    votes = np.zeros((loop.max(initial=-1) + 1, rim.max(initial=-1) + 1), int)
    np.add.at(votes, (loop, rim), 1)
    rim_of = votes.argmax(axis=1) if votes.size else np.zeros(0, int)  # the nearest to most of the loop
    torn = np.flatnonzero(np.bincount(rim_of) > 1)
    if len(torn) == 0 or not positive.any():
        return np.zeros(0, int)

    # The graph of the surface, and a node for each loop, half an edge away from the vertices along it.
    on_surface = np.flatnonzero(positive)
    beside = on_surface[cKDTree(vertices[on_surface]).query(border)[1]]
    beside, loop = np.unique(np.stack([beside, loop]), axis=1)
    a, b = edges[positive[edges].all(axis=1)].T
    length = np.linalg.norm(vertices[a] - vertices[b], axis=1)
    length = np.concatenate([length, np.full(len(beside), 0.5 * length.mean())])
    a, b = np.concatenate([a, beside]), np.concatenate([b, len(vertices) + loop])
    graph = coo_array((length, (a, b)), shape=(len(vertices) + len(rim_of),) * 2).tocsr()
    cut = np.zeros(len(vertices) + len(rim_of), bool)
    for one in torn:
        mine = len(vertices) + np.flatnonzero(rim_of == one)
        way, before, source = dijkstra(
            graph, directed=False, indices=mine, limit=reach, min_only=True, return_predecessors=True
        )
        whole = way[a] + length + way[b]
        meeting = np.flatnonzero((whole <= reach) & (source[a] != source[b]))
        joined = DisjointSet(mine.tolist())
        for edge in meeting[np.argsort(whole[meeting])]:
            if joined.merge(int(source[a[edge]]), int(source[b[edge]])):
                for vertex in (a[edge], b[edge]):
                    while vertex >= 0:
                        cut[vertex] = True
                        vertex = before[vertex]
    return np.flatnonzero(cut[: len(vertices)])
