"""Carving: the template is hollowed out where that explains views better that nothing was fitted to."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from ...template.msdf import clean_opacity, msdf_from_template, splat_to_lattice, without_specks
from ...topology import topology
from ...triangles import positive_part
from ..radiance.acceptance import close_rejected
from ..radiance.surface_radiance import SurfaceRadiance
from ..stage import Fit
from ..surface import Seen, Surface
from ..template import Template, template_of
from .fitted_radiance import fitted_radiance, ray_errors
from .hollows import SEEN, hollowed, hollows
from .radiance_volume import RadianceVolume

#: A hollow is kept if the error of rays that see into it falls below this fraction.
_GAIN = 0.95

#: Rays see into a hollow if they go this much farther than to the hull, in cells.
_DEEPER = 0.7

#: Space is empty below this opacity of a cell.
_EMPTY = 0.3

#: Logit of a vertex that is taken to be open (its negative).
_CERTAIN = 3.0

#: Batches of rays that judge.
_ERROR_STEPS = 20


def carve(fit: Fit, surface: Surface, volume: RadianceVolume) -> Surface | None:
    """Hollows out a template as far as held-out views are explained better.

    Args:
        fit: the views.
        surface: with its hull, on a lattice whose vertices make a cube.
        volume: trained.

    Returns:
        The hollowed surface and what was seen of it; None if there is no hollow, none helps, or the surface
        would get other boundary loops.
    """
    subject, lattice, min_area = fit.scene.subject, surface.lattice, fit.config.min_area
    shape = (lattice.stride,) * 3
    opacity, seen = volume.opacity(), volume.seen()
    in_cells = (field.reshape(shape) / lattice.spacing for field in (surface.hull, surface.fields.msdf))
    distance = hollows(*in_cells, opacity, seen)
    if distance is None:
        return None
    carved = hollowed(surface, distance)
    if not (carved.fields.sdf < 0).any():
        return None
    before = template_of(subject, surface)
    after = template_of(subject, carved, like=before)
    label, count = ndimage.label(distance > 0, np.ones((3, 3, 3)))
    label = np.where(label, label, ndimage.maximum_filter(label, size=3))
    appearances = [fitted_radiance(template, fit) for template in (before, after)]
    errors = _errors_in_hollows(*appearances, label, count, volume, fit, lattice.spacing)
    kept = errors[1] < _GAIN * errors[0]
    if not kept[1:].any():
        return None
    if not kept[1:].all():
        # Vertices beside a hollow belong to it.
        owner = ndimage.distance_transform_edt(label == 0, return_distances=False, return_indices=True)
        distance = np.where(kept[label[tuple(owner)]], distance, -np.inf)
        carved = hollowed(surface, distance)
        after = template_of(subject, carved, like=before)
        appearances[1] = fitted_radiance(after, fit)
    clean = partial(clean_opacity, vertices=after.vertices, faces=after.faces, min_area=min_area)
    cleaned = clean(after.logits)
    was, became = (topology(*positive_part(template.vertices, template.faces, logits))
                   for template, logits in ((before, before.logits), (after, cleaned)))
    if became.boundary_loops != was.boundary_loops or became.components > was.components:
        return None
    if not fit.config.watertight:
        # Now that what lies behind is in its place, the images may justify more openings.
        proposed = clean(np.where(_in_empty_space(after, volume, opacity, seen), -_CERTAIN, cleaned))
        appearance = SurfaceRadiance(after.start, after.faces, fit.views, fit.training, fit.config.radiance,
                                     seed=fit.config.seed)
        appearance.refit_anew(proposed > 0)
        justified = close_rejected(proposed, after.faces, appearance.image_error, volume.config.opening_gain)
        # Those that there were have been judged, and a close call may come out otherwise now.
        cleaned = clean(np.where(cleaned > 0, justified, proposed))
    radiance, found = splat_to_lattice(mi.Float(appearances[1].radiance()[0].ravel()), after.mesh, lattice)
    msdf = without_specks(msdf_from_template(cleaned, after.mesh, lattice), after.mesh, lattice, min_area)
    seen = Seen(radiance.numpy().reshape(-1, 3), found.numpy(), surface.seen.light)
    return replace(carved.with_fields(msdf=msdf.numpy()), seen=seen)


def _in_empty_space(template: Template, volume: RadianceVolume, opacity: np.ndarray,
                    seen: np.ndarray) -> np.ndarray:
    """(V,) whether there is nothing within a cell of a vertex, and it is seen."""
    local = volume.to_lattice @ mi.Point3f(np.ascontiguousarray(template.vertices.T, np.float32))
    index = ((local + 1) * (0.5 * volume.resolution)).numpy()[::-1]
    around = ndimage.gaussian_filter(opacity, 1.0)
    return ((ndimage.map_coordinates(around, index, order=1) < _EMPTY)
            & (ndimage.map_coordinates(seen, index, order=1) > SEEN))


def _errors_in_hollows(before: SurfaceRadiance, after: SurfaceRadiance, label: np.ndarray, count: int,
                       volume: RadianceVolume, fit: Fit, spacing: float) -> np.ndarray:
    """(2, count + 1) sums of both templates' errors over rays that see into each hollow, or through it.

    Rays that find nothing any more count by where they enter, and by their coverage: a hollow must leave the
    masks as they are. One that no ray sees into has no errors, hence no gain.
    """
    labels, side = mi.UInt32(label.ravel().astype(np.uint32)), dr.opaque(mi.UInt32, len(label))
    sums = [dr.zeros(mi.Float, count + 1) for _ in range(2)]
    config = fit.config
    with dr.suspend_grad():
        for step in range(_ERROR_STEPS):
            sample = fit.held_out.sample(config.radiance.batch, seed=config.seed, step=step)
            ray = fit.views.rays(sample.view, sample.film)
            near, far = (appearance.scene.ray_intersect_preliminary(ray, coherent=False)
                         for appearance in (before, after))
            # On a GPU, a kernel traces rays in one scene only.
            dr.eval(near)
            dr.eval(far)
            start = volume.to_lattice @ ray(near.t)
            through = near.is_valid() & ~far.is_valid()
            end = dr.select(through, start, volume.to_lattice @ ray(far.t))
            deeper = through | far.is_valid() & (dr.norm(end - start) > _DEEPER * spacing)
            x, y, z = mi.Vector3u(dr.clip(dr.round((end + 1) / spacing), 0, mi.Float(side - 1)))
            hollow = dr.gather(mi.UInt32, labels, x + side * (y + side * z), deeper)
            for appearance, total in zip((before, after), sums, strict=True):
                error = ray_errors(appearance, ray, sample, fit.held_out)
                dr.scatter_reduce(dr.ReduceOp.Add, total, error, hollow, deeper)
            dr.eval(sums)
    return np.stack([total.numpy() for total in sums])
