"""Scores of one surface against another, open ones included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from ..errors import UserError
from ..mesh_files import read_triangles
from ..topology import topology

_WINDING_SAMPLES = 5_000
#: Points of the winding number's comparison come from the reference's bounding box, enlarged by this.
_WINDING_MARGIN = 1.2

#: Distance below which a point counts as found, as a fraction of the reference's bounding box diagonal.
F_SCORE_DISTANCE = 0.005


def read_mesh(path: Path) -> trimesh.Trimesh:
    """A mesh file that trimesh reads, welded by position.

    Raises:
        UserError: the file is missing, holds no triangles with an area, or is damaged.
    """
    if not Path(path).is_file():
        raise UserError(f"Mesh '{path}' does not exist; check the path.")
    try:
        mesh = trimesh.Trimesh(*read_triangles(path), process=False)
    except ValueError as error:
        raise UserError(f"Mesh '{path}' {error}; give a PLY, OBJ, GLB or STL.") from error
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh


def mesh_scores(
    mesh: trimesh.Trimesh, reference: trimesh.Trimesh, samples: int = 200_000, seed: int = 0
) -> dict:
    """Distances in per cent of the reference's bounding box diagonal, and counts.

    ``chamfer`` is the mean of ``accuracy`` (from the mesh to the reference) and ``completeness`` (back), over
    ``samples`` points each, sampled uniformly: at 200 000 two samplings of one surface are about 0.1 % apart
    (``chamfer_floor``: the reference against itself). ``normal_consistency`` is the mean absolute cosine
    between normals at nearest points. ``winding_difference`` is the mean absolute difference of the
    generalised winding numbers (Jacobson et al. 2013; for open surfaces too) at random points of the box; it
    tells orientation and missing parts.
    """
    diagonal = float(np.linalg.norm(reference.extents))
    (a, face_a), (b, face_b) = (
        trimesh.sample.sample_surface(m, samples, seed=seed + i)[:2] for i, m in enumerate((mesh, reference))
    )
    c = trimesh.sample.sample_surface(reference, samples, seed=seed + 2)[0]
    tree_a, tree_b = cKDTree(a), cKDTree(b)
    (accuracy, _), (completeness, nearest), (floor, _) = tree_b.query(a), tree_a.query(b), tree_b.query(c)
    precision, recall = ((d < F_SCORE_DISTANCE * diagonal).mean() for d in (accuracy, completeness))
    cosine = np.abs((reference.face_normals[face_b] * mesh.face_normals[face_a[nearest]]).sum(1))
    percent = 100 / diagonal
    found, true = (topology(np.asarray(m.vertices), np.asarray(m.faces)) for m in (mesh, reference))
    return {
        "chamfer": float(percent * (accuracy.mean() + completeness.mean()) / 2),
        "chamfer_floor": float(percent * floor.mean()),
        "accuracy": float(percent * accuracy.mean()),
        "completeness": float(percent * completeness.mean()),
        "f_score": float(2 * precision * recall / max(precision + recall, 1e-12)),
        "normal_consistency": float(cosine.mean()),
        "winding_difference": _winding_difference(mesh, reference, seed),
        **{
            name: {"found": getattr(found, name), "reference": getattr(true, name)}
            for name in ("boundary_loops", "pinholes", "boundary_length", "components", "nonmanifold_edges")
        },
    }


def winding_numbers(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Generalised winding numbers at (N, 3) points: the solid angle of the surface, by 4 pi."""
    from gpytoolbox import fast_winding_number  # takes a second to import

    return fast_winding_number(points, np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32))


def _winding_difference(mesh: trimesh.Trimesh, reference: trimesh.Trimesh, seed: int) -> float:
    unit = np.random.default_rng(seed).uniform(-0.5, 0.5, (_WINDING_SAMPLES, 3))
    points = reference.bounds.mean(0) + _WINDING_MARGIN * reference.extents * unit
    return float(np.abs(winding_numbers(mesh, points) - winding_numbers(reference, points)).mean())
