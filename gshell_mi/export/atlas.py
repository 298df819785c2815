"""UV atlases by xatlas, in a process of their own: on some meshes it never ends."""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp

#: Steps of smoothing before unwrapping.
_SMOOTHING = 3


@dataclass(frozen=True)
class Atlas:
    """A mesh cut along the seams of a UV atlas.

    Attributes:
        source: (W,) index of the mesh's vertex that each vertex of the atlas is a copy of.
        faces: (F, 3) indices of the atlas's vertices, faces in the mesh's order.
        uv: (W, 2) in [0, 1], v upwards.
        charts: number of charts.
    """

    source: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    charts: int


def unwrap(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    texture_size: int = 1024,
    padding: int = 4,
    seconds: float = 60.0,
) -> Atlas | None:
    """Unwraps a mesh without overlaps; None if that fails or takes longer than ``seconds`` of the processors.

    xatlas is given slightly smoothed positions: noise of the surface's normals would scatter it over hundreds
    of charts, and an atlas of the smoothed mesh is one of the mesh too.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        texture_size: pixels per side of the texture that is wanted.
        padding: pixels between charts.
        seconds: time limit, less than a second more or less; 0: nothing is tried. Of the clock where the
            system does not limit a process's time (Windows).
    """
    if not seconds:
        return None
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "mesh.npz", Path(folder) / "atlas.npz"
        np.savez(
            given,
            vertices=_with_unit_faces(_smoothed(vertices, faces), len(faces)),
            faces=faces.astype(np.uint32),
            texture_size=texture_size,
            padding=padding,
        )
        limit = str(math.ceil(seconds))
        command = [sys.executable, str(Path(__file__).with_name("_unwrap.py")), str(given), str(found), limit]
        try:
            on_clock = seconds if sys.platform == "win32" else None
            subprocess.run(command, check=True, timeout=on_clock, capture_output=True)
            with np.load(found) as arrays:
                atlas = Atlas(
                    arrays["source"].astype(np.int64),
                    arrays["faces"].astype(np.int64),
                    arrays["uv"].astype(np.float64),
                    int(arrays["charts"]),
                )
        except (subprocess.SubprocessError, OSError):
            return None
    # What it could not unwrap it leaves at the origin or drops.
    same_faces = atlas.faces.shape == faces.shape and (atlas.source[atlas.faces] == faces).all()
    return atlas if same_faces and np.isfinite(atlas.uv).all() else None


def _with_unit_faces(vertices: np.ndarray, count: int) -> np.ndarray:
    """The positions around the origin, scaled to faces with areas of about 1, whatever the units:
    xatlas takes faces of less than 1e-7 for empty."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = np.sqrt(count) / max((high - low).max(), 1e-30)
    return ((vertices - (low + high) / 2) * scale).astype(np.float32)


def _smoothed(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = np.concatenate([edges, edges[:, ::-1]])
    adjacent = sp.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2).tocsr()
    adjacent.data[:] = 1
    mean = sp.diags(1 / np.maximum(np.asarray(adjacent.sum(1)).ravel(), 1)) @ adjacent
    smooth = np.asarray(vertices, np.float64)
    for _ in range(_SMOOTHING):
        smooth = 0.5 * (smooth + mean @ smooth)
    return smooth
