"""Revision: openings are judged again where the images have moved the surface.

They are first sought on a hull, before anything is known of exposures, cameras and hollows. Where much of
that is wrong, what is seen through a true opening is explained no better than by its cap, and a false one
may be right behind the surface. So the same radiance with opacity, and the same judge, are asked once more.
What is open and explains unseen views worse than its cap closes; what is proposed and explains them better
opens; what nobody tells of stays as it is.
"""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np

from ...fields.smoothing import MeshDiffusion
from ...template.msdf import clean_opacity, reopened, rewritten
from ...template.sides import opposite_sides
from ...topology import lobes
from ...triangles import positive_part
from ..judge import places_of
from ..radiance.acceptance import WORST, close_rejected, close_shallow
from ..radiance.shown import Mesh
from ..radiance.surface_radiance import SurfaceRadiance
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface
from .openings import OpacityTraining, OpeningsConfig, justified

#: Lambda that smooths new rims along the template.
_SMOOTHING = 3.0


class Revision:
    """Opens and closes what the images justify by now."""

    name = "revision"

    def __init__(self, config: OpeningsConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with other openings, if there are any."""
        lattice, count = surface.lattice, self.config.iterations
        template = fit.scene.subject.surface_of(surface.fields, template=True)
        vertices, faces, _ = template.to_numpy()
        msdf = mi.Float(surface.fields.msdf)
        values = template.interpolate(msdf).numpy() / lattice.spacing
        mirrored = fit.judge.shown(positive_part(vertices, faces, values)).mirrored
        appearance = SurfaceRadiance(vertices, faces, fit.views, fit.pixels, fit.config.radiance,
                                     seed=fit.config.seed, mirrored=mirrored)
        steps.run(OpacityTraining(appearance, self.config), count, {"radiance": appearance.optimizer})
        mesh = vertices, faces
        with steps.task("verdict"):
            proposed = appearance.smoothed_logits()
            thickness, opposite = opposite_sides(vertices, vertices, faces, fit.cell(surface))
            thin = np.isfinite(thickness)
            revised = _closed(fit, mesh, values, proposed, np.where(thin, opposite, -1))
            revised = _opened(fit, mesh, revised, proposed, thin)
            revised = clean_opacity(revised, *mesh, fit.config.topology.min_area)
        changed = (revised <= 0) != (values <= 0)
        steps.fact("openings_changed", bool(changed.any()))
        if not changed.any():
            return surface
        smooth = MeshDiffusion(faces, len(vertices), _SMOOTHING)
        cut, near = reopened(lattice.spacing * values, revised <= 0, smooth, lattice.spacing)
        msdf = rewritten(msdf, cut, near, template, lattice)
        return replace(surface.with_fields(msdf=msdf.numpy()), settled=False)


def _closed(fit: Fit, template: Mesh, values: np.ndarray, proposed: np.ndarray,
            opposite: np.ndarray) -> np.ndarray:
    """(V,) values, those of openings negated that unseen views explain better as surface.

    First what the radiance shows to be opaque in them, such as islands; then all of an opening. Through one
    opening others are seen, so the worst close first. Where a sheet has one side, what closes the other one
    is a cell from it, and looks alike.

    Args:
        fit, template, values, proposed: as of ``_opened``.
        opposite: (V,) vertex on the template's other side, -1 if that is not near.
    """
    for closing in (proposed > 0, np.ones_like(values, bool)):
        while (chosen := (values <= 0) & closing).any():
            place = places_of(chosen, lobes(chosen, template[1]))
            now = fit.judge.shown(positive_part(*template, values))
            closed = np.where(chosen, np.abs(values), values)
            after = fit.judge.shown(positive_part(*template, closed), like=now)
            verdict = fit.judge.compare(now, after, (template, place))
            backed = (opposite >= 0) & (values[opposite] > 0)
            alone = 2 * np.bincount(place[chosen], backed[chosen]) <= np.bincount(place[chosen])
            gain = np.where(verdict.accepted & alone, verdict.gain, 0)
            if not gain.any():
                break
            values = np.where(chosen & (gain >= WORST * gain.max())[place], -values, values)
    return values


def _opened(fit: Fit, template: Mesh, values: np.ndarray, proposed: np.ndarray,
            thin: np.ndarray) -> np.ndarray:
    """(V,) values, negative also where unseen views are explained better without the surface.

    Args:
        fit: the views.
        template: vertices and faces.
        values: (V,) negative at its openings.
        proposed: (V,) opacity logits.
        thin: (V,) where the template's other side is within two cells.
    """
    vertices, faces = template
    given = values <= 0
    now = fit.judge.shown(positive_part(vertices, faces, values))

    def clean(logits: np.ndarray) -> np.ndarray:
        both = np.where(given, values, logits)
        cleaned = clean_opacity(both, vertices, faces, fit.config.topology.min_area)
        return np.where(given, values, close_shallow(np.where(given, 1.0, cleaned), faces, thin))

    start = np.where(given, values, np.abs(proposed))
    return justified(proposed, start, clean, lambda candidate: close_rejected(
        candidate, template, fit.judge, now, given))
