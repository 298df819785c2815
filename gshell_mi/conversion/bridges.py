"""Edges of a template that leap from one layer of a mesh to another."""

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from .mesh_distance import Feet

#: Layers face different ways if the cosine between their normals is below this.
_TURN = 0.5

#: Sources per search, as a search returns a value per source and vertex.
_SOURCES = 64


def bridges(mesh: trimesh.Trimesh, feet: Feet, edges: np.ndarray, reach: float) -> np.ndarray:
    """The edges whose ends belong to places that are far from each other along the mesh.

    Where the rims of two layers come closer to each other than the lattice can tell, its template may turn
    from one layer into the other within an edge.

    Args:
        feet: of the template's vertices, on the mesh.
        edges: (n, 2) pairs of these vertices.
        reach: points up to this far from each other along the mesh belong together.

    Returns:
        (m, 2) edges, those of them that are bridges.
    """
    turning = np.einsum("ni,ni->n", *(feet.normal[edges[:, i]] for i in (0, 1))) < _TURN
    corners = mesh.faces[feet.face]
    adjacent = (corners[edges[:, 0], :, None] == corners[edges[:, 1], None, :]).any(axis=(1, 2))
    edges = edges[turning & ~adjacent]
    if len(edges) == 0:
        return edges
    # Ways lead along the edges of the mesh, and to and from a corner of the face: that much longer they are.
    sides = np.linalg.norm(np.diff(mesh.triangles[:, [0, 1, 2, 0]], axis=1), axis=2).max(axis=1)
    limit = reach + sides[feet.face[edges]].sum(axis=1)
    to_corner = np.linalg.norm(mesh.vertices[corners] - feet.point[:, None], axis=2)
    first = to_corner[edges[:, 0]].argmin(axis=1)
    source, row = np.unique(corners[edges[:, 0], first], return_inverse=True)
    a, b = mesh.edges_unique.T
    graph = coo_array((mesh.edges_unique_length, (a, b)), shape=(len(mesh.vertices),) * 2).tocsr()
    way = np.empty((len(edges), 3))
    for start in range(0, len(source), _SOURCES):
        found = dijkstra(graph, directed=False, indices=source[start : start + _SOURCES], limit=limit.max())
        here = (row >= start) & (row < start + _SOURCES)
        way[here] = found[row[here] - start, corners[edges[here, 1]].T].T
    way = to_corner[edges[:, 0], first] + (way + to_corner[edges[:, 1]]).min(axis=1)
    return edges[way > limit]
