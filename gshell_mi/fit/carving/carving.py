"""Carving: the template is hollowed out where that explains unseen views better."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import mitsuba as mi
import numpy as np
from scipy import ndimage

from ...radiance.volume import RadianceVolume
from ...template.msdf import CERTAIN, clean_opacity, msdf_from_template, without_specks
from ...topology import topology
from ...triangles import positive_part
from ..acceptance import close_rejected
from ..appearance import fitted_radiance
from ..stage import Fit
from ..surface import Seen, Surface
from ..template import Template, at_nearest, lattice_index, template_of
from .hollows import hollowed, hollows

#: Space is empty below this opacity of a cell.
_EMPTY = 0.3

#: Views that have to see a vertex: one alone does not know how far away what it sees is.
_SEEING = 2


def carve(fit: Fit, surface: Surface, volume: RadianceVolume) -> Surface | None:
    """Hollows out a template as far as unseen views are explained better.

    Args:
        fit: the views.
        surface: with its hull, on a lattice whose vertices make a cube.
        volume: trained.

    Returns:
        The hollowed surface and what was seen of it; None if there is no hollow, none helps, or the surface
        would get other boundary loops.
    """
    subject, lattice, min_area = fit.scene.subject, surface.lattice, fit.config.topology.min_area
    shape = (lattice.stride,) * 3
    opacity, seen = opacity_and_visibility(volume, surface, subject.to_world)
    hull, msdf = (
        field.reshape(shape) / lattice.spacing for field in (surface.hull_distance, surface.fields.msdf)
    )
    distance = hollows(hull, msdf, opacity, seen)
    if distance is None:
        return None
    carved = hollowed(surface, distance)
    if not (carved.fields.sdf < 0).any():
        return None
    before = template_of(subject, surface)
    after = template_of(subject, carved, like=before)
    label, _ = ndimage.label(distance > 0, np.ones((3, 3, 3)))
    # Vertices beside a hollow belong to it.
    label = np.where(label, label, ndimage.maximum_filter(label, size=3))
    owner = ndimage.distance_transform_edt(label == 0, return_distances=False, return_indices=True)
    kept = _kept(fit, before, after, label)
    if not kept.any():
        return None
    if not kept.all():
        distance = np.where(np.append(False, kept)[label[tuple(owner)]], distance, -np.inf)
        carved = hollowed(surface, distance)
        after = template_of(subject, carved, like=before)
    clean = partial(clean_opacity, vertices=after.vertices, faces=after.faces, min_area=min_area)
    cleaned = clean(after.logits)
    was, became = (
        topology(*positive_part(template.vertices, template.faces, logits))
        for template, logits in ((before, before.logits), (after, cleaned))
    )
    if became.boundary_loops != was.boundary_loops or became.components > was.components:
        return None
    if not fit.config.watertight:
        # Now that what lies behind is in its place, the images may justify more openings.
        proposed = clean(np.where(_in_empty_space(after, subject.to_world, opacity, seen), -CERTAIN, cleaned))
        closed = fit.judge.shown(after.closed)
        justified = close_rejected(proposed, closed, fit.judge, closed.whole)
        # Those that there were have been judged, and a close call may come out otherwise now.
        cleaned = clean(np.where(cleaned > 0, justified, proposed))
    radiance = fitted_radiance(fit, after).radiance()[0]
    msdf = without_specks(msdf_from_template(cleaned, after.mesh, lattice), after.mesh, lattice, min_area)
    seen = Seen.on(lattice, after.mesh, radiance, surface.sight.light)
    return replace(carved.with_fields(msdf=msdf.numpy()), seen=seen)


def opacity_and_visibility(
    volume: RadianceVolume, surface: Surface, to_world: mi.ScalarTransform4f
) -> tuple[np.ndarray, np.ndarray]:
    """What a volume says of the N^3 vertices of a surface's lattice. Away from the hull they are empty, and
    seen.

    Args:
        volume: trained.
        surface: with its hull, on a lattice whose vertices make a cube.
        to_world: from the lattice.

    Returns:
        (N, N, N) opacities of a cell's length in [0, 1], z by y by x, and (N, N, N) whether a vertex is seen.
    """
    lattice = surface.lattice
    near = np.flatnonzero(surface.hull_distance < 2 * lattice.spacing)
    points = mi.Transform4f(to_world) @ mi.Point3f(lattice.points(mi.Float).numpy()[:, near])
    opacity, seen = np.zeros(lattice.vertex_count, np.float32), np.ones(lattice.vertex_count, bool)
    opacity[near] = volume.opacity_at(points, lattice.spacing).numpy()
    seen[near] = volume.views_seeing(points).numpy() >= _SEEING
    shape = (lattice.stride,) * 3
    return opacity.reshape(shape), seen.reshape(shape)


def _in_empty_space(
    template: Template, to_world: mi.ScalarTransform4f, opacity: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """(V,) whether there is nothing within a cell of a vertex, and it is seen."""
    index = lattice_index(template.vertices, to_world, len(opacity) - 1)
    around = ndimage.gaussian_filter(opacity, 1.0)
    return (ndimage.map_coordinates(around, index, order=1) < _EMPTY) & ndimage.map_coordinates(
        seen, index, order=0
    )


def _kept(fit: Fit, before: Template, after: Template, label: np.ndarray) -> np.ndarray:
    """(count,) which hollows explain unseen views better, by the rays that enter them."""
    index = lattice_index(before.vertices, fit.scene.subject.to_world, len(label) - 1)
    place = at_nearest(label, index) - 1
    return fit.judge.compare(
        fit.judge.shown(before.surface).whole,
        fit.judge.shown(after.surface).whole,
        place,
        fit.judge.shown(before.closed),
        places=int(label.max()),
    ).accepted
