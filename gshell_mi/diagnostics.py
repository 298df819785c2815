"""What may be wrong with a reconstructed surface: one number each, and one sentence if it is too large."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import ArrayT
from .compat import mesh_scene
from .topology import mesh_components, topology
from .triangles import area_vectors, unit
from .views import PinholeViews
from .visibility import best_view
from .wording import counted

#: A piece of less than this fraction of the surface's area is a floater.
FLOATER = 0.02

#: Fractions of the area above which contact and lack of views are worth a warning.
CONTACT_LIMIT, UNOBSERVED_LIMIT = 0.05, 0.05

#: Sheets touch if a ray along the normal meets the other one within a cell, and that faces this one.
_FACING = -0.5


@dataclass(frozen=True)
class Diagnostics:
    """Findings on a surface and the template that it was cut from; areas as fractions of the surface's."""

    pieces: int
    """Connected components that are no floaters."""
    floaters: int
    """Components of less than 2 % of the area."""
    boundary_loops: int
    pinholes: int
    """Boundary loops shorter than 5 % of the diagonal."""
    self_contact: float
    """Area within a cell of another sheet of the template that faces it, on either side."""
    unobserved: float
    """Area that no view sees, from neither side."""
    unobserved_center: tuple[float, float, float] | None
    """Its centroid, world units; None without such area."""

    def warnings(self) -> list[str]:
        """One line for each finding that needs a look, with what to do."""
        found = []
        if not self.pieces:
            found.append("no surface is left: look at views/, and check cameras and masks.")
        if self.floaters:
            found.append(
                f"{counted(self.floaters, 'loose piece')} of less than 2 % of the area: raise "
                f"--topology.min-area, or add --losses.extra sdf_sign 0.002, or delete in Blender."
            )
        if self.pieces > 1:
            found.append(
                f"the surface is in {self.pieces} pieces: if the object is in one, its thin parts "
                f"were lost; raise --resolution."
            )
        if self.pinholes:
            found.append(
                f"{counted(self.pinholes, 'pin-hole')} beside "
                f"{counted(self.boundary_loops, 'boundary loop')}: add --losses.extra hole_closing "
                f"1, or raise --topology.min-area."
            )
        if self.self_contact > CONTACT_LIMIT:
            found.append(
                f"{100 * self.self_contact:.0f} % of the surface is within a cell of another sheet "
                f"of its template, where details merge: raise --resolution."
            )
        if self.unobserved > UNOBSERVED_LIMIT and self.unobserved_center:
            x, y, z = self.unobserved_center
            found.append(
                f"{100 * self.unobserved:.0f} % of the surface is seen by no view and is a guess: "
                f"add views of the parts around ({x:.2f}, {y:.2f}, {z:.2f})."
            )
        return found


def diagnose(
    surface: tuple[np.ndarray, np.ndarray],
    template: tuple[np.ndarray, np.ndarray],
    views: PinholeViews,
    cell: float,
) -> Diagnostics:
    """Looks for floaters, pin-holes, self-contact and unobserved area.

    Args:
        surface: (V, 3) vertices and (F, 3) faces of the open surface, world units.
        template: the same of the watertight surface that it was cut from.
        views: the cameras.
        cell: side of a lattice cell, world units.

    Two spheres, one of them tiny, seen from afar by one camera, which sees one half:

    >>> import trimesh
    >>> sensor = mi.load_dict({"type": "perspective", "fov": 10,
    ...     "to_world": mi.ScalarTransform4f().look_at([0, 0, 50], [0, 0, 0], [0, 1, 0])})
    >>> large, small = trimesh.creation.icosphere(4), trimesh.creation.icosphere(2, radius=0.05)
    >>> mesh = trimesh.util.concatenate([large, small.apply_translation([2, 0, 0])])
    >>> arrays = (mesh.vertices, mesh.faces)
    >>> found = diagnose(arrays, arrays, PinholeViews.from_sensors([sensor]), cell=0.1)
    >>> found.pieces, found.floaters, round(found.unobserved, 1)
    (1, 1, 0.5)
    """
    vertices, faces = surface
    counts = topology(vertices, faces)
    if len(faces) == 0:
        return Diagnostics(0, 0, 0, 0, 0.0, 0.0, None)
    doubled = area_vectors(vertices.astype(np.float64), faces)
    area, normals = 0.5 * np.linalg.norm(doubled, axis=1), unit(doubled)
    centers = vertices[faces].astype(np.float64).mean(axis=1)
    floaters = _floaters(len(vertices), faces, area)
    touching = _touching(centers, normals, template, cell)
    unseen = area * (best_view(centers, normals, surface, views) == 0)
    total = max(area.sum(), 1e-30)
    x, y, z = unseen @ centers / max(unseen.sum(), 1e-30)
    center = (float(x), float(y), float(z)) if unseen.any() else None
    return Diagnostics(
        counts.components - floaters,
        floaters,
        counts.boundary_loops,
        counts.pinholes,
        float(area[touching].sum() / total),
        float(unseen.sum() / total),
        center,
    )


def _floaters(vertex_count: int, faces: np.ndarray, area: np.ndarray) -> int:
    """Connected components of little area."""
    label = mesh_components(faces, vertex_count)[faces[:, 0]]
    areas = np.bincount(label, area)
    return int(((areas > 0) & (areas < FLOATER * area.sum())).sum())


def _touching(
    centers: np.ndarray, normals: np.ndarray, template: tuple[np.ndarray, np.ndarray], cell: float
) -> np.ndarray:
    """Which points of the template have another sheet of it within a cell, before or behind them."""
    scene = mesh_scene(*template)
    origin, normal = _vectors(mi.Point3f, centers), _vectors(mi.Vector3f, normals)
    touching = np.zeros(len(centers), bool)
    for direction in (normal, -normal):
        start = origin + direction * (1e-3 * cell)
        hit = scene.ray_intersect(mi.Ray3f(start, direction, cell, 0.0, mi.Color0f()))
        touching |= (hit.is_valid() & (dr.dot(hit.n, normal) < _FACING)).numpy()
    return touching


def _vectors(kind: type[ArrayT], rows: np.ndarray) -> ArrayT:
    return kind(np.ascontiguousarray(rows.T, np.float32))
