"""The surface of the union of closed parts that overlap or lie in one another."""

import numpy as np
import trimesh

#: Faces are split where parts cross, down to this many cells.
_FINEST_CELLS = 0.25
#: Faces larger than this many cells may cross a part between their corners.
_COARSEST_CELLS = 2.0
#: Outside of a face, how far away the winding number is taken, in cells.
_OUTSIDE_CELLS = 1e-3


def winding_at(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """(n,) generalised winding numbers of a mesh at points (n, 3)."""
    from gpytoolbox import fast_winding_number  # takes a second to import

    return fast_winding_number(
        np.ascontiguousarray(points, float),
        np.asarray(mesh.vertices, float),
        np.asarray(mesh.faces, np.int32),
    )


def visible_part(mesh: trimesh.Trimesh, cell: float) -> trimesh.Trimesh:
    """The faces of a closed mesh that bound the union of its parts, cut off where parts cross.

    Args:
        mesh: closed; wherever it winds at least once around a point, that is inside.
        cell: of the lattice that this is for; the cut is accurate to a fraction of it.
    """
    divided = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, _COARSEST_CELLS * cell, max_iter=20)
    vertices, faces = divided[:2]
    pieces = []
    triangles = vertices[faces]
    while len(triangles):
        hidden = _hidden(mesh, triangles, cell)
        side = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2).max(axis=1)
        mixed = hidden.any(axis=1) & ~hidden.all(axis=1) & (side > _FINEST_CELLS * cell)
        pieces.append(triangles[~mixed & (hidden.mean(axis=1) < 0.5)])
        triangles = _quartered(triangles[mixed])
    kept = np.concatenate(pieces)
    return trimesh.Trimesh(kept.reshape(-1, 3), np.arange(3 * len(kept)).reshape(-1, 3), process=False)


def _hidden(mesh: trimesh.Trimesh, triangles: np.ndarray, cell: float) -> np.ndarray:
    """(F, 4) whether the outside of faces is inside the union, near each corner and at the centre."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    center = triangles.mean(axis=1, keepdims=True)
    points = np.concatenate([0.9 * triangles + 0.1 * center, center], axis=1)
    points = points + _OUTSIDE_CELLS * cell * normal[:, None]
    return (winding_at(mesh, points.reshape(-1, 3)) > 0.5).reshape(-1, 4)


def _quartered(triangles: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(triangles, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate(
        [np.stack(corners, axis=1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
