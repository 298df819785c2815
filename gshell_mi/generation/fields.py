"""Pairs of truncated distances on a cubic grid, which data sets hold and models learn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import ndimage

from ..conversion import from_mesh
from ..extraction import extract
from ..lattice import TetLattice

#: Both distances are truncated at so many cells. Much less would make them steps, which few numbers describe
#: badly; much more has no part in the surface.
TRUNCATION_CELLS = 5.0
#: ``from_mesh`` gives the mSDF exactly up to so many cells.
_EXACT_MSDF_CELLS = 2.0
#: The ends of an edge that crosses the mesh are nearer to it than the longest edge, sqrt(3) cells; those of
#: one that crosses a cap may be far.
_LONGEST_EDGE = 1.8
#: Of the mSDF away from the template's edges, by means over 3^3 vertices.
_SMOOTHINGS = 16
#: Pieces and holes of fewer vertices are specks.
_SPECK = 12
#: What a speck becomes, by the truncation.
_FLIPPED = 0.05
#: Neighbours along the edges of the tetrahedral lattice.
_LATTICE_NEIGHBOURS = np.array(
    [
        [
            [(z >= 0 and y >= 0 and x >= 0) or (z <= 0 and y <= 0 and x <= 0) for x in (-1, 0, 1)]
            for y in (-1, 0, 1)
        ]
        for z in (-1, 0, 1)
    ]
)
#: Cells between a mesh and the cube's faces, so that its template closes within.
MARGIN_CELLS = 3.5


@dataclass(frozen=True)
class TruncatedFields:
    """Truncated distances, by their truncation: values in [-1, 1], indexed ``[z, y, x]``.

    On a grid of N^3 vertices, those of the lattice of N - 1 cells per side on [-1, 1]^3.
    """

    sdf: np.ndarray
    """(N, N, N): distance to the template, positive outside."""
    msdf: np.ndarray
    """(N, N, N): distance to the rims, >= 0 on the surface."""

    @property
    def side(self) -> int:
        """Vertices per side, N."""
        return len(self.sdf)

    @classmethod
    def stored(cls, sdf: np.ndarray, msdf: np.ndarray) -> TruncatedFields:
        """Those that a data set holds in half precision."""
        return cls(sdf.astype(np.float32), msdf.astype(np.float32))

    @classmethod
    def of_mesh(cls, mesh: trimesh.Trimesh, side: int) -> TruncatedFields:
        """Those of a mesh that lies in the cube as ``normalised`` puts it. Needs a Mitsuba variant.

        Raises:
            UserError: ``from_mesh`` refuses the mesh.
        """
        fields = from_mesh(mesh, TetLattice(side - 1))
        cell, shape = fields.lattice.spacing, (side, side, side)
        return cls.continued(fields.sdf.reshape(shape) / cell, fields.msdf.reshape(shape) / cell)

    @classmethod
    def continued(cls, sdf: np.ndarray, msdf: np.ndarray) -> TruncatedFields:
        """From fields in cells whose mSDF is known at the edges that cross the template, and no farther than
        two cells from a rim: smooth distances everywhere, with the same surface.

        Across openings ``sdf`` becomes the distance to the cap; ``msdf`` goes on as the distance to the rim.

        Args:
            sdf: (N, N, N); infinite where only its sign is known.
            msdf: (N, N, N).
        """
        used, rim = _template_ends(sdf, msdf)
        if not used.any():
            return cls(np.copysign(1, sdf).astype(np.float32), np.sign(msdf).astype(np.float32))
        # On caps the distance to the mesh says nothing.
        sdf = np.where(used & (np.abs(sdf) > _LONGEST_EDGE), np.copysign(0.5, sdf), sdf)
        away, nearest = ndimage.distance_transform_edt(~used, return_indices=True)
        sdf = np.copysign(np.minimum(np.abs(sdf), away + np.abs(sdf[tuple(nearest)])), sdf)
        to_rim = ndimage.distance_transform_edt(~rim) if rim.any() else np.full(sdf.shape, np.inf)
        beyond = np.abs(msdf) > _EXACT_MSDF_CELLS - 0.01
        msdf = np.where(beyond, np.copysign(np.maximum(to_rim, _EXACT_MSDF_CELLS), msdf), msdf)
        msdf = np.clip(msdf, -TRUNCATION_CELLS, TRUNCATION_CELLS)[tuple(nearest)]
        # Between a sheet and a cap its sign would leap, where nothing of the surface is.
        for _ in range(_SMOOTHINGS):
            msdf = np.where(used, msdf, ndimage.uniform_filter(msdf, 3, mode="nearest"))
        return cls(*(np.clip(field / TRUNCATION_CELLS, -1, 1).astype(np.float32) for field in (sdf, msdf)))

    def surface(self, *, largest: bool = False) -> trimesh.Trimesh:
        """The open mesh {sdf = 0, msdf >= 0}. Needs a Mitsuba variant.

        Args:
            largest: without specks, and of its pieces only those with at least a fiftieth of the faces of the
                largest; models leave crumbs.
        """
        if largest:
            return _without_crumbs(self.without_specks().surface())
        import mitsuba as mi

        lattice = TetLattice(self.side - 1)
        sdf = np.array(self.sdf, np.float32)
        border = lattice.on_border().reshape(sdf.shape)
        sdf[border] = np.maximum(sdf[border], 0.1)  # the template closes inside the lattice
        msdf = np.ascontiguousarray(self.msdf, np.float32)
        found = extract(lattice, mi.Float(sdf.ravel()), mi.Float(msdf.ravel()))
        vertices, faces, _ = found.to_numpy()
        return trimesh.Trimesh(vertices, faces, process=False)

    def without_specks(self) -> TruncatedFields:
        """The same without pieces and bubbles of the template, and patches and holes of the surface, of fewer
        than 12 vertices: less than about two cells across, they are below what the grid resolves."""
        inside = _despeckled(self.sdf < 0, np.ones(self.sdf.shape, bool))
        sdf = np.where(inside == (self.sdf < 0), self.sdf, np.where(inside, -_FLIPPED, _FLIPPED))
        used, _ = _template_ends(sdf, self.msdf)
        kept = _despeckled(self.msdf >= 0, used)
        msdf = np.where(kept == (self.msdf >= 0), self.msdf, np.where(kept, _FLIPPED, -_FLIPPED))
        return TruncatedFields(sdf.astype(np.float32), msdf.astype(np.float32))


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


def lattice_edges(side: int) -> Iterator[tuple[tuple[int, int, int], np.ndarray, np.ndarray]]:
    """Of each of the 7 directions of the tetrahedral lattice's edges: the step (z, y, x), and the ends of all
    such edges by number."""
    number = np.arange(side**3).reshape(side, side, side)
    for step in range(1, 8):
        offset = (step >> 2, step >> 1 & 1, step & 1)
        low = number[tuple(slice(0, side - o) for o in offset)]
        high = number[tuple(slice(o, side) for o in offset)]
        yield offset, low.ravel(), high.ravel()


def _template_ends(sdf: np.ndarray, msdf: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertices at the ends of edges that cross the template, and those of them beside a rim."""
    inside, kept = sdf.ravel() < 0, msdf.ravel() >= 0
    used, rim = np.zeros(sdf.size, bool), np.zeros(sdf.size, bool)
    for _, a, b in lattice_edges(len(sdf)):
        crossing = inside[a] != inside[b]
        used[a[crossing]] = used[b[crossing]] = True
    for _, a, b in lattice_edges(len(sdf)):
        cut = used[a] & used[b] & (kept[a] != kept[b])
        rim[a[cut]] = rim[b[cut]] = True
    return used.reshape(sdf.shape), rim.reshape(sdf.shape)


def _despeckled(mask: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The mask, with small components of it and of its complement, both within ``where``, flipped."""
    found = mask.copy()
    for value in (True, False):
        labels, count = ndimage.label((found == value) & where, _LATTICE_NEIGHBOURS)
        small = np.bincount(labels.ravel(), minlength=count + 1) < _SPECK
        small[0] = False
        found = np.where(small[labels], not value, found)
    return found


def _without_crumbs(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    from ..topology import mesh_components

    if len(mesh.faces) == 0:
        return mesh

    piece = mesh_components(np.asarray(mesh.faces), len(mesh.vertices))[mesh.faces[:, 0]]
    size = np.bincount(piece)
    used, faces = np.unique(mesh.faces[(50 * size >= size.max())[piece]], return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[used], faces.reshape(-1, 3), process=False)
