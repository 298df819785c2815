"""Parts of a solid that are thinner than a lattice cell, made thick enough for the lattice to hold them.

A sheet in a visual hull (a brim, a hem, a leaf) may be thinner than a cell. The lattice then sees it at some
of its vertices and misses it at others: the template is frayed or falls apart.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy import ndimage

#: A part is thin where no ball of this radius, in cells, that fits inside comes as near as twice its radius:
#: sheets of up to a cell, and edges sharper than 60 degrees.
_RADIUS = 0.5

#: Half the thickness, in cells, that a lattice never misses.
_HALF = 0.8

#: The solid is sampled up to this many times finer than the lattice ...
_REFINEMENT = 3

#: ... with at most so many cells per side, as memory grows with their cube.
_MOST_CELLS = 256


def thin_part_refinement(resolution: int) -> int:
    """Cells per cell of a lattice of ``resolution`` at which to look for parts too thin for it.

    >>> [thin_part_refinement(resolution) for resolution in (64, 128, 256, 512)]
    [3, 2, 1, 1]
    """
    return max(min(_REFINEMENT, _MOST_CELLS // resolution), 1)


def thickened(sdf: np.ndarray, refinement: int) -> np.ndarray:
    """Grows the parts of a solid that a lattice would slip through.

    Args:
        sdf: (n, n, n) signed distances, in cells of the lattice, sampled on a finer grid.
        refinement: samples per cell along each axis.

    Returns:
        The distances to the grown solid, likewise; ``sdf`` itself if nothing is thin.
    """
    thin, core = sdf < 0, sdf < -_RADIUS
    if core.any():
        thin &= ndimage.distance_transform_edt(~core) > 2 * _RADIUS * refinement
    if not thin.any():
        return sdf
    around = 2 * refinement + 1
    half = ndimage.maximum_filter(np.where(thin, -sdf, 0), size=around)
    growth = np.where(thin, np.clip(_HALF - half, 0, None), 0)
    # The lattice vertices that will hold the part lie beside it.
    return sdf - ndimage.gaussian_filter(ndimage.maximum_filter(growth, size=around), 0.5 * refinement)


def back_on_solid(vertices: np.ndarray, faces: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Undoes the growth: moves vertices against their normals by their (V,) distance from the solid itself.

    Args:
        vertices: (V, 3) of the grown template.
        faces: (F, 3), oriented outwards.
        distance: in the unit of the vertices; negative ones do not count.
    """
    normals = np.array(trimesh.Trimesh(vertices, faces, process=False).vertex_normals)
    return vertices - np.maximum(distance, 0)[:, None] * normals
