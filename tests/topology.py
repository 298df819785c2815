"""Facts about triangle meshes that tests assert."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def assert_manifold(vertices: np.ndarray, faces: np.ndarray) -> None:
    """Asserts an oriented edge- and vertex-manifold with boundary and without waste or degeneracy."""
    assert np.isfinite(vertices).all()
    assert len(faces) == 0 or (faces.min() >= 0 and faces.max() < len(vertices))
    assert len(np.unique(faces)) == len(vertices), "unreferenced vertices"
    assert len(np.unique(np.sort(faces, axis=1), axis=0)) == len(faces), "duplicate faces"

    p = vertices.astype(np.float64)[faces]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    assert (area > 0).all(), "zero-area faces"
    assert len(np.unique(vertices, axis=0)) == len(vertices), "coinciding vertices"

    directed = _directed_edges(faces)
    assert len(np.unique(directed, axis=0)) == len(directed), "an edge is used twice in one direction"
    boundary = boundary_edges(faces)
    starts, ends = np.unique(boundary[:, 0]), np.unique(boundary[:, 1])
    assert len(starts) == len(boundary), "a boundary vertex has more than two boundary edges"
    assert np.array_equal(starts, ends)
    assert fan_count(faces) == len(vertices), "a vertex joins several fans of faces"


def _directed_edges(faces: np.ndarray) -> np.ndarray:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def boundary_edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges (E, 2) that no face uses in the other direction."""
    directed = _directed_edges(faces)
    count = faces.max(initial=0) + 1
    key, opposite = directed[:, 0] * count + directed[:, 1], directed[:, 1] * count + directed[:, 0]
    return directed[~np.isin(key, opposite)]


def loop_count(faces: np.ndarray) -> int:
    """Boundary loops, counted as connected components of the boundary edges."""
    edges = boundary_edges(faces)
    if len(edges) == 0:
        return 0
    names, local = np.unique(edges, return_inverse=True)
    local = local.reshape(edges.shape)
    graph = coo_array((np.ones(len(local)), local.T), shape=(len(names),) * 2)
    return connected_components(graph, directed=False)[0]


def component_count(faces: np.ndarray) -> int:
    """Components connected by edges; every vertex must be used."""
    directed = _directed_edges(faces)
    size = faces.max(initial=-1) + 1
    graph = coo_array((np.ones(len(directed)), directed.T), shape=(size, size))
    return connected_components(graph, directed=False)[0]


def euler_characteristic(faces: np.ndarray) -> int:
    edges = np.unique(np.sort(_directed_edges(faces), axis=1), axis=0)
    return len(np.unique(faces)) - len(edges) + len(faces)


def fan_count(faces: np.ndarray) -> int:
    """Fans of faces around vertices: as many as vertices if and only if none is pinched."""
    face = np.arange(len(faces))
    directed = _directed_edges(faces)
    start_corner = np.concatenate([3 * face, 3 * face + 1, 3 * face + 2])
    end_corner = np.concatenate([3 * face + 1, 3 * face + 2, 3 * face])
    order = np.lexsort(np.sort(directed, axis=1).T)
    directed, start_corner, end_corner = directed[order], start_corner[order], end_corner[order]
    twin = (directed[:-1] == directed[1:, ::-1]).all(axis=1).nonzero()[0]
    joins = np.concatenate(
        [
            np.stack([start_corner[twin], end_corner[twin + 1]]),
            np.stack([end_corner[twin], start_corner[twin + 1]]),
        ],
        axis=1,
    )
    graph = coo_array((np.ones(joins.shape[1]), joins), shape=(3 * len(faces),) * 2)
    return connected_components(graph, directed=False)[0]
