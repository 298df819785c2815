"""Revision: openings are judged again where the images have moved the surface.

They are first sought on a hull, before anything is known of exposures, cameras and hollows. Where much of
that is wrong, what is seen through a true opening is explained no better than by its cap, and a false one
may be right behind the surface. So the same radiance with opacity, and the same judge, are asked once more.
An opening that explains unseen views no better than a cap does closes; what is proposed and explains them
better opens, or becomes a recess if that explains them as well; what nobody tells of stays as it is. Other
recesses, and dents that are none, are judged in the same way.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from ...extraction.surface_mesh import SurfaceMesh
from ...radiance.shown import Mesh, Shown
from ...template.caps import Recesses, least_bent
from ...template.moved_parts import with_moved_parts
from ...template.msdf import clean_opacity, reopened, rewritten, rim_diffusion
from ...template.revoxelise import HELD
from ...template.sides import opposite_sides
from ...topology import inner, lobes
from ...triangles import positive_part
from ..acceptance import close_rejected, islands, open_rejected, worst_of
from ..appearance import radiance_on
from ..carving.dents import without_dents
from ..carving.recesses import recess_depths, sunk
from ..judge import Judge, places_of
from ..runner import Steps
from ..sheets import SURE
from ..stage import Fit
from ..surface import Surface
from .openings import OpacityTraining, OpeningsConfig, further_openings

#: Standard errors by which an opening has to explain more than a cap: half of what it takes to open one. A
#: false slit below the chair's rail has from -2.0 to 3.7, from fit to fit; true openings have 1.9 to 13.
_STANDING = 1.0


class Revision:
    """Opens and closes what the images justify by now."""

    name = "revision"

    def __init__(self, config: OpeningsConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with other openings, if there are any."""
        cell, (template, values) = fit.cell(surface), cut_template(fit, surface)
        vertices, faces, _ = template.to_numpy()
        judge = fit.outline_judge
        now = judge.shown(positive_part(vertices, faces, values))
        proposed = proposals(fit, now, (vertices, faces), self.config, steps)
        with steps.task("verdict"):
            thickness, opposite = opposite_sides(vertices, vertices, faces, cell)
            thin = np.isfinite(thickness)
            smooth = least_bent(vertices, faces, (values <= 0) & ~thin)
            revised = _closed(
                judge, judge.shown((smooth, faces), like=now), values, np.where(thin, opposite, -1)
            )
            capped = (values <= 0) & (revised > 0)
            moved = np.where(capped[:, None], smooth, vertices)
            shown = judge.shown((moved, faces), like=now)
            revised = _with_islands(judge, shown, revised, proposed)
            revised, shown = _opened(fit, shown, revised, proposed, cell)
            recessed = sunk(fit, shown, revised, proposed, cell)
            deeper = (recessed != moved).any(axis=1)
            revised = clean_opacity(revised, moved, faces, fit.config.topology.min_area)
        changed = (revised <= 0) != (values <= 0)
        steps.fact("openings_changed", bool(changed.any()))
        steps.fact("recessed_vertices", int((deeper & (revised > 0)).sum()))
        elsewhere = (capped | deeper) & (revised > 0)
        if changed.any():
            surface = opened_at(surface, template, values, revised <= 0)
        if elsewhere.any():
            moved = np.where(elsewhere[:, None], recessed, vertices)
            surface = replace(_moved(fit, surface, vertices, moved, faces, revised), settled=False)
        with steps.task("dents"):
            filled, dents = without_dents(fit, surface)
        if dents is not None:
            steps.fact("dents_verdict", dents.facts())
        steps.fact("dents_filled", filled is not surface)
        return surface if filled is surface else replace(filled, settled=False)


def cut_template(fit: Fit, surface: Surface) -> tuple[SurfaceMesh, np.ndarray]:
    """A surface's template, and what cuts it: (V,) values, in cells, negative where it is open."""
    template = fit.scene.subject.surface_of(surface.fields, template=True)
    return template, template.interpolate(mi.Float(surface.fields.msdf)).numpy() / surface.lattice.spacing


def proposals(fit: Fit, now: Shown, template: Mesh, config: OpeningsConfig, steps: Steps) -> np.ndarray:
    """(V,) opacity logits of a closed template, of a radiance that mirrors what the surface ``now`` does."""
    appearance = radiance_on(fit, template, now)
    optimizers = {"radiance": appearance.optimizer}
    steps.run(OpacityTraining(appearance, config), config.iterations, optimizers)
    return appearance.smoothed_logits()


def opened_at(surface: Surface, template: SurfaceMesh, values: np.ndarray, opened: np.ndarray) -> Surface:
    """The surface with the openings, (V,) of its template's vertices, and smooth rims where they differ from
    those of its ``values``, (V,) in cells."""
    _, faces, _ = template.to_numpy()
    lattice, smooth = surface.lattice, rim_diffusion(faces, len(values))
    cut, near = reopened(lattice.spacing * values, opened, smooth, lattice.spacing)
    msdf = rewritten(mi.Float(surface.fields.msdf), cut, near, template, lattice).numpy()
    return replace(surface.with_fields(msdf=msdf), settled=False)


def _moved(
    fit: Fit, surface: Surface, vertices: np.ndarray, moved: np.ndarray, faces: np.ndarray, values: np.ndarray
) -> Surface:
    """The surface where vertices of its template, (V, 3), have moved. It has no opening there but where the
    (V,) values are negative."""
    # It may move farther than the blocks reach that fields are stored in.
    blocks, surface = surface.fields.blocks is not None, surface.whole()
    lattice, fields, cell = surface.lattice, surface.fields, fit.cell(surface)
    every = dr.arange(mi.UInt32, lattice.vertex_count)
    points = lattice.offset_positions(every, mi.Float(fields.deform), mi.Float)
    points = (mi.Transform4f(fit.scene.subject.to_world) @ mi.Point3f(points)).numpy().T
    sdf, told = with_moved_parts(fields.sdf / lattice.spacing, points, vertices, moved, faces, cell)
    told = np.flatnonzero(told)
    told = told[values[cKDTree(moved).query(points[told])[1]] > 0]
    msdf = np.array(fields.msdf)
    msdf[told] = np.maximum(np.abs(msdf[told]), SURE * lattice.spacing)
    surface = surface.with_fields(sdf=(lattice.spacing * sdf).astype(np.float32), msdf=msdf)
    return surface.in_blocks() if blocks else surface


def _closed(judge: Judge, template: Shown, values: np.ndarray, opposite: np.ndarray) -> np.ndarray:
    """Closes openings that explain unseen views hardly better than caps that go on as their surroundings do.

    Nothing has shaped the caps so far, and a hull's bulge explains too little to stand for a surface. Through
    one opening others are seen, a mouth through a hole in the bottom, so the worst closes alone before the
    others are judged again. Where an opening ends is found to a cell at best, so vertices at its rim tell
    nothing; a false slit is little else. Nor do those where a sheet has one side: what closes the other one
    is a cell from it, and looks alike.

    Args:
        judge: of the fit.
        template: with such caps, closed.
        values: (V,) negative at its openings.
        opposite: (V,) vertex on the template's other side, -1 if that is not near.

    Returns:
        (V,) values, those of closed openings negated.
    """
    thin, faces = opposite >= 0, template.mesh[1]
    while (chosen := values <= 0).any():
        place = places_of(chosen, lobes(chosen, faces))
        backed = thin & (values[opposite] > 0)
        middle = np.where(inner(chosen, faces) & ~backed, place, -1)
        verdict = judge.compare(template.part(values), template.whole, middle, places=place.max() + 1)
        gain = np.where(np.isfinite(verdict.noise), verdict.gain + _STANDING * verdict.noise, 0)
        if gain.max() <= 0:
            break
        values = np.where(chosen & (place == gain.argmax()), -values, values)
    return values


def _with_islands(judge: Judge, template: Shown, values: np.ndarray, proposed: np.ndarray) -> np.ndarray:
    """(V,) values, those in openings negated where the radiance shows something opaque that explains unseen
    views better, such as an island."""
    while (chosen := (values <= 0) & (proposed > 0)).any():
        place = places_of(chosen, lobes(chosen, template.mesh[1]))
        after = template.part(np.where(chosen, np.abs(values), values))
        verdict = judge.compare(template.part(values), after, place)
        opaque = worst_of(np.where(verdict.accepted, verdict.gain, 0))
        if not opaque.any():
            break
        values = np.where(chosen & opaque[place], -values, values)
    return values


def _opened(
    fit: Fit, template: Shown, values: np.ndarray, proposed: np.ndarray, cell: float
) -> tuple[np.ndarray, Shown]:
    """Opens, or moves deeper, what explains unseen views better so.

    Args:
        fit: the views.
        template: closed.
        values: (V,) negative at its openings.
        proposed: (V,) opacity logits.
        cell: side of a lattice cell, world units.

    Returns:
        (V,) values, negative also at new openings; the template, where recesses have come.
    """
    (vertices, faces), judge = template.mesh, fit.outline_judge
    given, now = values <= 0, template.part(values)
    standing = islands(~given, faces)[0]

    def judged(candidate: np.ndarray) -> np.ndarray:
        kept = close_rejected(candidate, template, judge, now, given)
        return open_rejected(kept, template, judge, standing)

    values = further_openings(template.mesh, values, proposed, fit.config.topology.min_area, judged)
    opened = (values <= 0) & ~given
    if not opened.any():
        return values, template
    place = places_of(opened, lobes(opened, faces))
    recesses = Recesses(vertices, faces, place, HELD * cell)
    closed = np.where(opened, -values, values)
    depth, least = recess_depths(judge, template, recesses, closed, values, place, cell)
    values = np.where(opened & ~(least > 0)[place], -values, values)
    depth[least > 0] = 0
    # Each was judged beside others that may have come out otherwise.
    together = judge.shown((recesses.at(depth), faces), like=template).part(values)
    better = judge.compare(now, together, place, template).gain > 0
    recessed = recesses.at(np.where(better, depth, 0)), faces
    return np.where(opened & ~better[place], closed, values), judge.shown(recessed, like=template)
