"""Pairs of truncated distances on a cubic grid, which data sets hold and models learn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import ndimage

from ..conversion import from_mesh
from ..extraction import extract
from ..lattice import TetLattice

#: The signed distance is truncated at so many cells, as it is exact no farther from the mesh.
SDF_CELLS = 3.0
#: The same for the mSDF.
MSDF_CELLS = 2.0
#: Cells between a mesh and the cube's faces, so that its template closes within.
MARGIN_CELLS = 3.5
#: Beside the surface's edges the mSDF goes on as it was, and sinks to -1 where the signed distance, by its
#: truncation, goes from this to 1.
_FADE = 0.6


@dataclass(frozen=True)
class TruncatedFields:
    """Truncated distances, by their truncation: values in [-1, 1], indexed ``[z, y, x]``.

    On a grid of N^3 vertices, those of the lattice of N - 1 cells per side on [-1, 1]^3.
    """

    sdf: np.ndarray
    """(N, N, N), 1 at ``SDF_CELLS`` cells or more outside of the template."""
    msdf: np.ndarray
    """(N, N, N), >= 0 on the surface; -1 far from it."""

    @property
    def side(self) -> int:
        """Vertices per side, N."""
        return len(self.sdf)

    @classmethod
    def of_mesh(cls, mesh: trimesh.Trimesh, side: int) -> TruncatedFields:
        """Those of a mesh that lies in the cube as ``normalised`` puts it. Needs a Mitsuba variant.

        Raises:
            UserError: ``from_mesh`` refuses the mesh.
        """
        fields = from_mesh(mesh, TetLattice(side - 1))
        cell = fields.lattice.spacing
        shape = (side, side, side)
        sdf = np.clip(fields.sdf.reshape(shape) / (SDF_CELLS * cell), -1, 1)
        msdf = fields.msdf.reshape(shape)
        msdf = np.clip(msdf / (MSDF_CELLS * cell), -1, 1)
        # What no crossing edge takes part in holds a constant there: it becomes what its neighbours are.
        unused = fields.msdf.reshape(shape) == np.float32(-cell)
        if unused.any() and not unused.all():
            nearest = ndimage.distance_transform_edt(unused, return_distances=False, return_indices=True)
            near = np.clip((1 - np.abs(sdf)) / (1 - _FADE), 0, 1)
            msdf = np.where(unused, (msdf[tuple(nearest)] + 1) * near - 1, msdf)
        return cls(sdf.astype(np.float32), msdf.astype(np.float32))

    def surface(self, *, largest: bool = False) -> trimesh.Trimesh:
        """The open mesh {sdf = 0, msdf >= 0}. Needs a Mitsuba variant.

        Args:
            largest: of its pieces only those with at least a fiftieth of the faces of the largest; models
                leave crumbs.
        """
        import mitsuba as mi

        lattice = TetLattice(self.side - 1)
        sdf = np.array(self.sdf, np.float32)
        border = lattice.on_border().reshape(sdf.shape)
        sdf[border] = np.maximum(sdf[border], 0.1)  # the template closes inside the lattice
        msdf = np.ascontiguousarray(self.msdf, np.float32)
        found = extract(lattice, mi.Float(sdf.ravel()), mi.Float(msdf.ravel()))
        vertices, faces, _ = found.to_numpy()
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return _without_crumbs(mesh) if largest and len(faces) else mesh


def normalised(mesh: trimesh.Trimesh, side: int) -> tuple[trimesh.Trimesh, np.ndarray]:
    """A copy, centred in [-1, 1]^3 and as large as the grid of ``side`` vertices per side holds it.

    Returns:
        The mesh, and the 4 x 4 matrix that brings it back.
    """
    half = max(float(np.ptp(mesh.vertices, axis=0).max()) / 2, 1e-12)
    scale = half / (1 - MARGIN_CELLS * 2 / (side - 1))
    back = np.diag([scale, scale, scale, 1.0])
    back[:3, 3] = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    return trimesh.Trimesh((mesh.vertices - back[:3, 3]) / scale, mesh.faces, process=False), back


def _without_crumbs(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    from ..topology import mesh_components

    piece = mesh_components(np.asarray(mesh.faces), len(mesh.vertices))[mesh.faces[:, 0]]
    size = np.bincount(piece)
    used, faces = np.unique(mesh.faces[(50 * size >= size.max())[piece]], return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[used], faces.reshape(-1, 3), process=False)
