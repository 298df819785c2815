"""Which way the faces of a mesh look: evenly within each piece, and outwards where a piece is closed."""

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from ..topology import vertex_components


def oriented(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with the faces turned that look another way than most of their piece's area.

    Across an edge of more than two faces nothing is compared. A piece that cannot be oriented, such as a
    Moebius strip, keeps one seam. A closed piece with negative volume is turned outwards, unless it lies in
    another and so is a hollow in it.
    """
    _, inverse, uses = np.unique(mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)
    order = np.argsort(inverse, kind="stable")
    pair = order[uses[inverse[order]] == 2].reshape(-1, 2)
    first, second = (pair // 3).T  # the sides of face f are 3 f to 3 f + 2
    agree = (mesh.edges[pair[:, 0]] == mesh.edges[pair[:, 1]][:, ::-1]).all(axis=1)
    flip = _flips(len(mesh.faces), mesh.area_faces, first, second, agree)
    faces = np.where(flip[:, None], mesh.faces[:, ::-1], mesh.faces)
    piece = vertex_components(np.stack([first, second], axis=1), len(faces))[1]
    return trimesh.Trimesh(
        mesh.vertices, _outwards(mesh.vertices, faces, piece, inverse, uses), process=False
    )


def _flips(
    count: int, area: np.ndarray, first: np.ndarray, second: np.ndarray, agree: np.ndarray
) -> np.ndarray:
    """(F,) which faces to turn so that each pair of neighbours agrees, where that is possible.

    Each face is there twice, as it is and turned; neighbours that agree join the like ones.
    """
    if agree.all():
        return np.zeros(count, bool)
    there = np.where(agree, second, second + count), np.where(agree, second + count, second)
    joined = np.concatenate([np.stack([first, there[0]], 1), np.stack([first + count, there[1]], 1)])
    kinds, label = vertex_components(joined, 2 * count)
    kept, turned = label[:count], label[count:]
    weight = np.bincount(kept, area, kinds)
    flip = (weight[kept] < weight[turned]) | ((weight[kept] == weight[turned]) & (kept > turned))
    for one in np.unique(kept[kept == turned]):  # not orientable: along a tree, which leaves one seam
        members = np.flatnonzero(kept == one)
        inside = kept[first] == one
        graph = coo_array(
            (np.where(agree, 1, 2)[inside], (first[inside], second[inside])), (count, count)
        ).tocsr()
        row, before = breadth_first_order(graph, members[0], directed=False)
        both = graph + graph.T
        flip[members] = False
        disagree = np.asarray(both[row[1:], before[row[1:]]]).ravel() == 2
        for face, parent, differs in zip(row[1:], before[row[1:]], disagree, strict=True):
            flip[face] = flip[parent] ^ differs
    return flip


def _outwards(
    vertices: np.ndarray, faces: np.ndarray, piece: np.ndarray, edge_of_side: np.ndarray, uses: np.ndarray
) -> np.ndarray:
    """The faces, with closed pieces turned that enclose a negative volume and are no hollows."""
    rim = (uses[edge_of_side] != 2).reshape(-1, 3).any(axis=1)
    count = piece.max() + 1
    closed = np.bincount(piece, rim, count) == 0
    corners = vertices[faces]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    corners = corners - (low + high) / 2
    volume = np.bincount(
        piece, np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])), count
    )
    if closed.all() and volume.sum() < 0:  # hollows included
        faces, volume = faces[:, ::-1], -volume
    inside_out = np.flatnonzero(closed & (volume < 0))
    if len(inside_out) == 0:
        return faces
    faces = faces.copy()
    for one in inside_out:
        others = faces[closed[piece] & (piece != one)]
        if not _is_hollow(vertices, others, vertices[faces[piece == one][0, 0]]):
            faces[piece == one] = faces[piece == one][:, ::-1]
    return faces


def _is_hollow(vertices: np.ndarray, others: np.ndarray, point: np.ndarray) -> bool:
    """Whether the closed faces ``others`` wind around a point, whichever way they look."""
    if len(others) == 0:
        return False
    a, b, c = np.moveaxis(vertices[others] - point, 1, 0)
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    # Van Oosterom and Strackee 1983.
    numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
    denominator = (
        la * lb * lc
        + np.einsum("ij,ij->i", a, b) * lc
        + np.einsum("ij,ij->i", b, c) * la
        + np.einsum("ij,ij->i", c, a) * lb
    )
    return bool(abs(np.arctan2(numerator, denominator).sum()) > np.pi)
