"""Lips: what is left of a lid at its rim, or grew there, goes unless it explains something.

A rim moves along the template, and where it has moved too far, beyond the end of a sheet, it goes on across
the opening. Of such a lip images tell little: it may be coloured like what is behind.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..fields.smoothing import MeshDiffusion
from ..template.msdf import clean_opacity, reopened, rewritten
from ..topology import lobes
from ..triangles import positive_part
from .judge import Judge, places_of
from .radiance.acceptance import gains_at
from .radiance.shown import Shown
from .stage import Fit
from .surface import Surface

#: Rings of vertices that may go, at most: lips are some cells wide.
_RINGS = 8

#: Lambda that smooths the new rims along the template.
_SMOOTHING = 3.0


def without_lips(fit: Fit, surface: Surface) -> Surface:
    """The surface without what explains unseen views no better than its absence, at rims."""
    lattice, fields = surface.lattice, surface.fields
    template = fit.scene.subject.surface_of(fields, template=True)
    vertices, faces, _ = template.to_numpy()
    values = template.interpolate(mi.Float(fields.msdf)).numpy() / lattice.spacing
    if fit.config.watertight or (values > 0).all() or (values <= 0).all():
        return surface
    judge = fit.rim_judge
    now = judge.shown(positive_part(vertices, faces, values))
    told = told_without_lips(values, judge.shown((vertices, faces), like=now), judge)
    if (told == values).all():
        return surface
    told = clean_opacity(told, vertices, faces, fit.config.topology.min_area)
    smooth = MeshDiffusion(faces, len(vertices), _SMOOTHING)
    cut, near = reopened(lattice.spacing * values, told <= 0, smooth, lattice.spacing)
    return surface.with_fields(msdf=rewritten(mi.Float(fields.msdf), cut, near, template, lattice).numpy())


def told_without_lips(values: np.ndarray, template: Shown, judge: Judge) -> np.ndarray:
    """(V,) values, those of lips negated.

    Who sees neither gain nor loss takes less surface. Ring after ring, vertices at rims that speak against
    themselves go where they hang together. All that goes has to explain unseen views surely better.

    Args:
        values: (V,) negative at openings.
        template: what is opened, closed.
        judge: of the fit.
    """
    faces, start, gone = template.mesh[1], values, np.zeros(len(values), bool)
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    for _ in range(_RINGS):
        rim, now = np.zeros_like(gone), template.part(values)
        rim[edges[(values[edges] <= 0).any(axis=1)]] = True
        rim &= values > 0
        after = template.part(np.where(rim, -values, values))
        chosen = rim & (gains_at(judge, faces, now, after, rim) > 0)
        if not chosen.any():
            break
        place = places_of(chosen, lobes(chosen, faces))
        verdict = judge.compare(now, template.part(np.where(chosen, -values, values)), place)
        chosen &= ((verdict.gain > 0) & np.isfinite(verdict.noise))[place]
        gone |= chosen
        values = np.where(chosen, -values, values)
    if not gone.any():
        return start
    verdict = judge.compare(template.part(start), template.part(values), np.where(gone, 0, -1))
    return values if verdict.accepted[0] else start
