"""Fields of a triangle mesh, closed or open, to start from."""

from pathlib import Path

import numpy as np
import trimesh
from scipy import ndimage

from ..errors import UserError
from ..fields import LatticeFields
from ..lattice import Lattice
from .layers import separate_layers
from .loaded_mesh import loaded_mesh
from .mesh_distance import Feet, MeshFeet, nearest_faces
from .rim_cut import rim_cut
from .united import visible_part, winding_at
from .winding_number import winding_number

_BAND_CELLS = 3.0  # distances are exact and signs those of the nearest face this near the mesh
# Past a rim the template goes on in the tangent plane for this long, so that the mSDF cuts it cleanly.
_RIM_CELLS = 2.0
# Somewhere a closed mesh winds around a point more than once; the winding number is blurred by a cell.
_TWICE = 1.3


def from_mesh(
    source: str | Path | trimesh.Trimesh, lattice: Lattice, *, to_world: np.ndarray | None = None
) -> LatticeFields:
    """Fields whose surface is the mesh, to the accuracy of the lattice. Needs a Mitsuba variant to be set.

    Near the mesh ``sdf`` is the distance to it, signed by the pseudonormal of the nearest point (Baerentzen
    and Aanaes 2005). Farther away, and across openings, the sign is that of the generalised winding number
    (Jacobson et al. 2013) as a harmonic function on the lattice that jumps by 1 across the mesh, which caps
    the openings. ``msdf`` is fitted, at the vertices of the template that results, to the distance to the
    rims along the mesh, negative past them and on the caps. Repeated faces count once, and pieces are
    oriented evenly (see ``loaded_mesh``). Where all is closed, parts that overlap or lie in one another are
    united, but one that looks inwards is a hollow of the other.
    Layers closer to each other than about two cells run into each other here and there, but their rims stay
    apart as far as the lattice can tell them.

    Args:
        source: a file that trimesh reads, or a mesh.
        to_world: 4x4 matrix from lattice units to those of the mesh; identity by default.

    Raises:
        UserError: the file cannot be read, holds no faces, has positions that are not finite, or does not
            fit into the lattice.

    >>> from gshell_mi.lattice import TetLattice
    >>> fields = from_mesh(trimesh.creation.icosphere(radius=0.6), TetLattice(16))
    >>> bool((fields.msdf > 0).all()), round(float(fields.sdf[17**3 // 2]), 2)
    (True, -0.6)
    """
    name = "the mesh" if isinstance(source, trimesh.Trimesh) else str(source)
    mesh = loaded_mesh(source, name, to_world)
    extent = np.abs(mesh.bounds).max()
    h = lattice.spacing
    if extent > 1 - h:
        raise UserError(
            f"{name}: reaches to {extent:.3g} of the lattice's cube [-1, 1]^3, of which the outer layer of "
            "cells must stay free; enlarge to_world"
        )
    winding = np.concatenate([winding_number(grid, mesh) for grid in lattice.grids])
    feet_of = MeshFeet(mesh)
    if len(feet_of.rim_edges) == 0 and winding.max() > _TWICE:
        return _united(mesh, lattice, winding, name)
    points = lattice.vertex_positions().astype(float)
    band, face = nearest_faces(mesh, lattice, _BAND_CELLS * h)
    feet = feet_of(points[band], face[:, None])

    far = _far_distance(lattice, points, band, feet)
    sdf = np.where(winding > 0.5, -far, far)
    near = np.where(feet.height < 0, -feet.distance, feet.distance)
    near[feet.on_rim] = np.copysign(feet.distance, sdf[band])[feet.on_rim]
    beside_rim = feet.on_rim & (feet.distance < _RIM_CELLS * h)
    near[beside_rim] = feet.height[beside_rim]
    sdf[band] = near
    if not mesh.is_watertight:
        separate_layers(sdf, mesh, lattice, band)
    border = lattice.on_border()
    sdf[border] = np.maximum(np.abs(sdf), h / 2)[border]  # the template closes inside the lattice

    fields = _with_surface(sdf, lattice, name)
    if len(feet_of.rim_edges) == 0:
        return fields
    nearest = np.full(lattice.vertex_count, -1)
    nearest[band] = face
    msdf = rim_cut(fields, feet_of, nearest, *feet_of.rim_samples(h / 8))
    return LatticeFields(fields.sdf, msdf, fields.deform, lattice.grid)


def _united(mesh: trimesh.Trimesh, lattice: Lattice, winding: np.ndarray, name: str) -> LatticeFields:
    """Of closed parts that cover each other: distances to what can be seen of them, signed by winding."""
    points = lattice.vertex_positions().astype(float)
    visible = visible_part(mesh, lattice.spacing)
    band, face = nearest_faces(visible, lattice, _BAND_CELLS * lattice.spacing)
    feet = MeshFeet(visible)(points[band], face[:, None])
    sdf = np.where(winding > 0.5, -1, 1) * _far_distance(lattice, points, band, feet)
    sdf[band] = np.where(winding_at(mesh, points[band]) > 0.5, -feet.distance, feet.distance)
    border = lattice.on_border()
    sdf[border] = np.maximum(np.abs(sdf), lattice.spacing / 2)[border]
    return _with_surface(sdf, lattice, name)


def _with_surface(sdf: np.ndarray, lattice: Lattice, name: str) -> LatticeFields:
    if not np.isfinite(sdf).all() or not (sdf < 0).any():
        raise UserError(
            f"{name}: leaves no surface on a lattice with cells of {lattice.spacing:.3g}, "
            f"as it is too small or thin; raise the resolution, or lessen to_world"
        )
    return LatticeFields.closed(sdf, lattice.grid)


def _far_distance(lattice: Lattice, points: np.ndarray, band: np.ndarray, feet: Feet) -> np.ndarray:
    """Distances of all lattice vertices to the foot of the nearest vertex beside the mesh."""
    beside = feet.distance < lattice.spacing
    away = np.ones(lattice.vertex_count, bool)
    away[band[beside]] = False
    shape = (lattice.stride,) * 3
    foot = np.zeros((lattice.vertex_count, 3))
    foot[band] = feet.point
    nearest = [
        grid.first
        + np.ravel_multi_index(
            tuple(
                ndimage.distance_transform_edt(
                    away[grid.ids].reshape(shape), return_distances=False, return_indices=True
                )
            ),
            shape,
        ).ravel()
        for grid in lattice.grids
    ]
    return np.linalg.norm(points - foot[np.concatenate(nearest)], axis=1)
