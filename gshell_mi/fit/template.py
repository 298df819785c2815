"""The template that the stages between hull and joint stage work on, and what of it is surface."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from ..extraction.surface_mesh import SurfaceMesh
from ..fields import LatticeFields
from ..fields.thin_parts import back_on_solid
from ..lattice import BlockLattice, Lattice
from ..preview import Preview
from ..template.msdf import CERTAIN
from ..triangles import positive_part
from .stage import Fit
from .surface import Surface

#: Linear grey of a surface whose colours are not asked for.
_GREY = 0.5

#: A template takes its opacity from another one that is at most this many cells away.
_REACH = 1.5


@dataclass(frozen=True)
class Template:
    """A watertight mesh with an opacity.

    Attributes:
        mesh: as extracted, with its stencil.
        vertices: (V, 3) its vertices, world units.
        faces: (F, 3), oriented outwards.
        logits: (V,) surface where positive, open elsewhere.
        start: (V, 3) where the vertices were before thin parts were grown.
    """

    mesh: SurfaceMesh
    vertices: np.ndarray
    faces: np.ndarray
    logits: np.ndarray
    start: np.ndarray

    @property
    def closed(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces before thin parts were grown, openings closed."""
        return self.start, self.faces

    @property
    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces of what is surface, before thin parts were grown."""
        return positive_part(self.start, self.faces, self.logits)

    @property
    def solid(self) -> np.ndarray:
        """(V,) whether a vertex belongs to the surface."""
        return self.logits > 0


def closed_template(
    subject: mi.Shape, sdf: np.ndarray, lattice: Lattice | BlockLattice
) -> tuple[SurfaceMesh, np.ndarray, np.ndarray]:
    """The template that is where ``sdf`` changes sign, its vertices (V, 3) and its faces (F, 3).

    Args:
        subject: the gshell shape, in whose place it is.
        sdf: at the vertices of ``lattice``.
        lattice: need not be the shape's own.
    """
    mesh = subject.surface_of(LatticeFields.closed(sdf, lattice.grid), template=True)
    vertices, faces, _ = mesh.to_numpy()
    return mesh, vertices, faces


def template_of(subject: mi.Shape, surface: Surface, *, like: Template | None = None) -> Template:
    """Extracts a template from lattice fields.

    Args:
        subject: the gshell shape, in whose place it is.
        surface: offsets of the lattice's vertices are left out.
        like: a template before a change of shape, whose opacity the new one takes over. New parts are solid.
    """
    lattice, fields = surface.lattice, surface.fields
    mesh, vertices, faces = closed_template(subject, fields.sdf, lattice)
    logits = mesh.interpolate(mi.Float(fields.msdf)).numpy() / lattice.spacing
    if like is not None:
        distance, nearest = cKDTree(like.vertices).query(vertices)
        near = distance < _REACH * lattice.spacing * subject.length_scale
        logits = np.where(near, like.logits[nearest], CERTAIN)
    start = vertices
    if surface.hull is not None:
        excess = mesh.interpolate(mi.Float(surface.hull)).numpy()
        start = back_on_solid(vertices, faces, np.where(logits > 0, subject.length_scale * excess, 0))
    return Template(mesh, vertices, faces, logits, start)


def preview_of(fit: Fit, surface: Surface) -> Preview:
    """A surface between two stages, where stages have moved its template to, all in grey; nothing if nothing
    was found yet."""
    subject = fit.scene.subject
    if surface.hull is None and surface.seen is None:
        nothing, none = np.zeros((0, 3)), np.zeros((0, 3), int)
        return Preview(nothing, none, nothing, nothing, none)
    if surface.moved or surface.hull is not None:
        template = template_of(subject, surface)
        at, faces = surface.moved[0].positions if surface.moved else template.start, template.faces
        vertices, kept = positive_part(at, faces, template.logits)
    else:
        (vertices, kept), (at, faces) = (
            subject.surface_of(surface.fields, template=closed).to_numpy()[:2] for closed in (False, True)
        )
    return Preview(vertices, kept, np.full(vertices.shape, _GREY), at, faces)


def lattice_index(points: np.ndarray, to_world: mi.ScalarTransform4f, side: int) -> np.ndarray:
    """Where world positions are in an array of a lattice's vertices: (3, V), z, y and x, with fractions.

    Args:
        points: (V, 3) world positions.
        to_world: from the cube [-1, 1]^3 of the lattice.
        side: cells per side.
    """
    local = mi.Transform4f(to_world).inverse() @ mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    return ((local + 1) * (0.5 * side)).numpy()[::-1]


def at_nearest(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """(V,) what an array of a lattice's vertices, (n, n, n), has at those nearest to (3, V) indices.

    >>> at_nearest(np.arange(8).reshape(2, 2, 2), np.array([[0.4, 5.0], [0.6, 1.0], [0.0, -3.0]])).tolist()
    [2, 6]
    """
    return values[tuple(np.clip(np.rint(index).astype(int), 0, len(values) - 1))]
