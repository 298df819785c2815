"""From one object to its row in a data set, or the reason why it has none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from ..errors import UserError
from ..topology import Topology, topology
from ..wording import counted
from .fields import TruncatedFields, normalised
from .sources import Source
from .surface_points import surface_points

#: Points that a row keeps of its surface, for scores.
POINTS = 2048
#: Points of the round trip's chamfer distance.
_CHECKED = 20_000


@dataclass(frozen=True)
class Row:
    """An object as it is stored."""

    source: Source
    fields: TruncatedFields
    points: np.ndarray
    """(``POINTS``, 3): on the surface, uniformly, in the units of the cube."""
    loops: int
    """Boundary loops of the object."""
    chamfer: float
    """Of the mesh that the fields stand for, in per cent of the bounding box's diagonal."""
    loops_kept: bool
    """Whether that mesh has as many loops and components."""


def converted(source: Source, side: int, *, most: float) -> Row:
    """The row of an object. Needs a Mitsuba variant.

    Args:
        side: vertices per side of the grid.
        most: chamfer distance, in per cent of the bounding box's diagonal, beyond which it is refused.

    Raises:
        UserError: the object is refused; the sentence tells why.
    """
    mesh, expected = source.mesh()
    mesh, _ = normalised(mesh, side)
    fields = TruncatedFields.of_mesh(mesh, side)
    stored = TruncatedFields.stored(fields.sdf.astype(np.float16), fields.msdf.astype(np.float16))
    again = stored.surface()
    if len(again.faces) == 0:
        raise UserError("leaves no surface on the grid; it is too small or thin")
    true, found = (topology(np.asarray(m.vertices), np.asarray(m.faces)) for m in (mesh, again))
    chamfer = round_trip(again, mesh)
    if chamfer > most:
        raise UserError(f"its fields are {chamfer:.2f} % of its size away from it, more than {most:g} %")
    if expected is not None and found.boundary_loops != expected:
        raise UserError(f"its fields have {counted(found.boundary_loops, 'boundary loop')}, not {expected}")
    points, _ = surface_points(mesh, POINTS)
    return Row(source, stored, points, true.boundary_loops, chamfer, _alike(true, found))


def round_trip(found: trimesh.Trimesh, true: trimesh.Trimesh) -> float:
    """Chamfer distance in per cent of the true one's diagonal, less what two samplings of one surface have:
    from points on either to the nearest triangle's plane near the nearest point of the other."""
    both = [surface_points(mesh, _CHECKED, seed) for seed, mesh in enumerate((found, true))]
    distance = []
    for (points, _), (others, faces), mesh in ((both[0], both[1], true), (both[1], both[0], found)):
        gap, nearest = cKDTree(others).query(points)
        offset = points - others[nearest]
        off_plane = np.abs(np.einsum("ij,ij->i", offset, mesh.face_normals[faces[nearest]]))
        # Beside the surface, as past a rim, the nearest sample is farther than samples are from each other.
        spacing = 2 * np.sqrt(mesh.area / _CHECKED)
        distance.append(np.where(gap < spacing, off_plane, gap).mean())
    return float(100 * np.mean(distance) / np.linalg.norm(true.extents))


def _alike(true: Topology, found: Topology) -> bool:
    return (true.boundary_loops, true.components) == (found.boundary_loops, found.components)
