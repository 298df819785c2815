"""Well-shaped triangles: isotropic remeshing that keeps the boundary loops."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .. import memory
from ..errors import UserError
from ..topology import mesh_edges, topology
from ..triangles import face_areas, unit

_PASSES = 10

#: A collapse may turn no triangle further than the angle with this cosine; where that leaves bad triangles,
#: which are then part of a tiny fold, the next one counts.
_GREATEST_TURNS = (0.2, -0.5, -1.0)

#: Factors on the edge length, tried in turn: a corner that cannot be repaired seldom comes out twice.
_ATTEMPTS = (1.0, 0.97, 1.03, 0.94)

#: Quality below which a triangle has no normal to speak of.
_DEGENERATE = 0.02

#: Bytes per new triangle, measured with 32 000 and 126 000.
_PER_TRIANGLE = 450


def triangle_quality(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Shape of triangles, 4 √3 area / (sum of squared edge lengths): 1 if equilateral, 0 if degenerate.

    >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    >>> round(float(triangle_quality(corners, np.array([[0, 1, 2]]))[0]), 3)
    0.866
    """
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    squared = sum((edge**2).sum(1) for edge in (b - a, c - b, a - c))
    return 4 * np.sqrt(3) * face_areas(vertices, faces) / np.maximum(squared, 1e-300)


def edge_length_for(vertices: np.ndarray, faces: np.ndarray, face_count: int) -> float:
    """Edge length at which equilateral triangles of the mesh's area number ``face_count``."""
    area = face_areas(vertices, faces).sum()
    return float(np.sqrt(4 / np.sqrt(3) * area / face_count))


def remesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    edge_length: float,
    *,
    resample_boundary: bool = False,
    min_quality: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Isotropic triangles on the same surface (Botsch and Kobbelt, "A Remeshing Approach to Multiresolution
    Modeling", SGP 2004; implementation: gpytoolbox).

    Args:
        vertices: (V, 3), manifold with boundary.
        faces: (F, 3).
        edge_length: of the new triangles, world units.
        resample_boundary: merge boundary vertices that are closer than ``edge_length``; otherwise every
            boundary vertex and edge stays exactly where it is.
        min_quality: collapse triangles until none is worse than this (see ``triangle_quality``); needs
            ``resample_boundary`` unless the boundary already has well-spaced vertices.

    Returns:
        The new vertices and faces.

    Raises:
        UserError: the length is not positive or exceeds the object, its triangles would need more memory than
            is free, the topology would change, or ``min_quality`` is out of reach.
    """
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    if not 0 < edge_length < size / 4:
        raise UserError(
            f"An edge length of {edge_length:g} does not suit an object of size {size:.3g}; "
            f"give one between 0 and {size / 4:.3g}."
        )
    count = int(4 / np.sqrt(3) * face_areas(vertices, faces).sum() / edge_length**2)
    memory.require(
        _PER_TRIANGLE * count,
        memory.free_memory(),
        f"Remeshing to edges of {edge_length:g}, some {count:,} triangles,",
        f"the object's size is {size:.3g}: give a longer edge",
    )
    before = topology(vertices, faces)
    for factor in _ATTEMPTS if min_quality > 0 else (1.0,):
        v, f = _remesh_once(vertices, faces, factor * edge_length, resample_boundary, min_quality)
        worst = triangle_quality(v, f).min()
        after = topology(v, f)
        changed = [
            name
            for name in ("components", "boundary_loops", "nonmanifold_edges")
            if getattr(after, name) != getattr(before, name)
        ]
        if worst >= min_quality and not changed:
            return v, f
    if changed:
        raise UserError(
            f"Remeshing to edges of {edge_length:g} would change the number of "
            f"{changed[0].replace('_', ' ')} from {getattr(before, changed[0])} to "
            f"{getattr(after, changed[0])}; take a smaller edge length."
        )
    raise UserError(
        f"The worst triangle has a quality of {worst:.3f}, below {min_quality:g}; try another "
        f"edge length or a lower quality."
    )


def _remesh_once(
    vertices: np.ndarray, faces: np.ndarray, edge_length: float, resample_boundary: bool, min_quality: float
) -> tuple[np.ndarray, np.ndarray]:
    import gpytoolbox  # takes a second to import

    v, f = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    if min_quality > 0:
        v, f = _collapse(v, f, lambda v, f: _bad_edges(v, f, 0.5 * min_quality))
    if resample_boundary:
        v, f = _collapse(v, f, lambda v, f: _short_boundary_edges(v, f, 0.8 * edge_length))
    v, f = gpytoolbox.remesh_botsch(v, np.asarray(f, np.int32), _PASSES, edge_length, True)
    v, f = np.asarray(v, np.float64), np.asarray(f, np.int64)
    if min_quality > 0:
        for greatest_turn in _GREATEST_TURNS:
            v, f = _collapse(v, f, lambda v, f: _bad_edges(v, f, min_quality), greatest_turn)
            v, f = _trim(v, _flip(v, f, min_quality), min_quality)
    return v, f


def _boundary_vertices(faces: np.ndarray, count: int) -> np.ndarray:
    edges, uses = mesh_edges(faces)
    found = np.zeros(count, bool)
    found[edges[uses == 1]] = True
    return found


def _short_boundary_edges(v: np.ndarray, f: np.ndarray, length: float) -> np.ndarray:
    edges, uses = mesh_edges(f)
    edges = edges[uses == 1]
    lengths = np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1)
    return edges[np.argsort(lengths)][: (lengths < length).sum()]


def _bad_edges(v: np.ndarray, f: np.ndarray, min_quality: float) -> np.ndarray:
    """The edges of each bad triangle, its shortest first, the worst triangle first."""
    quality = triangle_quality(v, f)
    corners = f[np.argsort(quality)[: (quality < min_quality).sum()]]
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1)
    lengths = np.linalg.norm(v[edges[..., 0]] - v[edges[..., 1]], axis=-1)
    return np.take_along_axis(edges, lengths.argsort(axis=1)[..., None], axis=1).reshape(-1, 2)


def _collapse(
    v: np.ndarray,
    f: np.ndarray,
    candidates: Callable[[np.ndarray, np.ndarray], np.ndarray],
    greatest_turn: float = _GREATEST_TURNS[0],
) -> tuple[np.ndarray, np.ndarray]:
    """Collapses the edges that ``candidates(v, f)`` lists, in that order, until none is left that may be."""
    v = v.copy()
    while True:
        done = _collapse_once(v, f, candidates(v, f), greatest_turn)
        if done is None:
            break
        f = done
    used, inverse = np.unique(f, return_inverse=True)
    return v[used], inverse.reshape(-1, 3)


def _collapse_once(
    v: np.ndarray, f: np.ndarray, edges: np.ndarray, greatest_turn: float
) -> np.ndarray | None:
    """One round of collapses whose neighbourhoods do not touch; None if there was nothing to do.

    A collapse keeps the surface a manifold of the same topology if the two ends have no other common
    neighbours than the corners opposite the edge (Dey et al. 1999), and, where both lie on the boundary, the
    edge does too. It must not turn a triangle over either.
    """
    boundary = _boundary_vertices(f, len(v))
    all_edges, uses = mesh_edges(f)
    boundary_edges = set(map(tuple, all_edges[uses == 1].tolist()))
    order = np.argsort(f.ravel(), kind="stable")
    ends = np.searchsorted(f.ravel()[order], np.arange(len(v) + 1))
    touched, gone, merged = np.zeros(len(v), bool), np.zeros(len(f), bool), np.arange(len(v))
    changed = False
    for a, b in edges.tolist():
        faces_a, faces_b = (order[ends[i] : ends[i + 1]] // 3 for i in (a, b))
        ring = np.unique(f[np.concatenate([faces_a, faces_b])])
        if touched[ring].any():
            continue
        on_boundary = (min(a, b), max(a, b)) in boundary_edges
        if boundary[a] and boundary[b] and not on_boundary:
            continue
        shared = np.intersect1d(faces_a, faces_b)
        common = np.intersect1d(f[faces_a], f[faces_b])
        if len(common) != 2 + len(shared):
            continue
        keep, drop = (b, a) if boundary[b] and not boundary[a] else (a, b)
        at = 0.5 * (v[a] + v[b]) if boundary[a] == boundary[b] else v[keep]
        others = np.setdiff1d(np.union1d(faces_a, faces_b), shared)
        if len(others) == 0:
            continue
        moved = f[others]
        corners = v[moved]
        corners[(moved == a) | (moved == b)] = at
        turned = (_normals(corners) * _normals(v[moved])).sum(1) < greatest_turn
        # The normal of a degenerate triangle says nothing.
        if (turned & (triangle_quality(v, moved) > _DEGENERATE)).any():
            continue
        v[keep] = at
        merged[drop] = keep
        gone[shared] = True
        touched[ring] = True
        changed = True
    return merged[f[~gone]] if changed else None


def _flip(v: np.ndarray, f: np.ndarray, min_quality: float) -> np.ndarray:
    """Turns the longest edge of bad triangles to the other diagonal where the worse of the two gains."""
    f = f.copy()
    bad = np.argsort(triangle_quality(v, f))
    for index in bad[: (triangle_quality(v, f) < min_quality).sum()].tolist():
        corners = v[f[index]]
        at = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).argmax()
        a, b, c = np.roll(f[index], -at).tolist()
        across = np.flatnonzero(((f == a).any(1)) & ((f == b).any(1)))
        if len(across) != 2:
            continue
        other = int(across[across != index][0])
        (d,) = set(f[other].tolist()) - {a, b}
        flipped = np.array([[a, d, c], [d, b, c]])
        exists = ((f == c).any(1) & (f == d).any(1)).any()
        if not exists and triangle_quality(v, flipped).min() > triangle_quality(v, f[[index, other]]).min():
            f[[index, other]] = flipped
    return f


def _trim(v: np.ndarray, f: np.ndarray, min_quality: float) -> tuple[np.ndarray, np.ndarray]:
    """Removes bad triangles from the boundary where that leaves a manifold of the same topology: those with
    two boundary edges, and those with one whose third vertex lies inside."""
    while True:
        boundary = _boundary_vertices(f, len(v))
        edges, uses = mesh_edges(f)
        at_boundary = uses[_edge_index(edges, f)] == 1
        ears = at_boundary.sum(1) == 2
        opposite = np.take_along_axis(f, (at_boundary.argmax(1)[:, None] + 2) % 3, axis=1)[:, 0]
        flat = (at_boundary.sum(1) == 1) & ~boundary[opposite]
        removable = np.flatnonzero((ears | flat) & (triangle_quality(v, f) < min_quality))
        if len(removable) == 0:
            used, inverse = np.unique(f, return_inverse=True)
            return v[used], inverse.reshape(-1, 3)
        f = np.delete(f, removable[0], axis=0)


def _edge_index(edges: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) rows of ``edges`` for the edges from each corner of the faces to the next."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1)
    count = edges.max() + 1
    return np.searchsorted(edges[:, 0] * count + edges[:, 1], pairs[..., 0] * count + pairs[..., 1])


def _normals(corners: np.ndarray) -> np.ndarray:
    return unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
