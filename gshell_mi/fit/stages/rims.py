"""Rims: openings grow to where the finished surface ends.

What an opening grows by is no discrete change: its rim moves, and no loop comes or goes. But steps of an
optimiser move it by a cell or so, and pieces of the lid that was in a mouth are larger. On the surface that
the last steps leave, the same radiance with opacity and the same judge see where such pieces explain less
than what is behind them.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ...radiance.shown import Mesh, Shown
from ...topology import lobes, mesh_edges, spread
from ...triangles import positive_part
from ..acceptance import close_rejected, parts_with
from ..judge import Judge, places_of
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface
from .openings import OpeningsConfig, further_openings
from .revision import cut_template, opened_at, proposals

#: Edges of the template by which a rim is drawn anew around what it has grown by.
_REDRAWN = 3


class Rims:
    """Lets the openings that there are grow, where unseen views are explained better so."""

    name = "rims"

    def __init__(self, config: OpeningsConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with wider openings."""
        template, values = cut_template(fit, surface)
        vertices, faces, _ = template.to_numpy()
        given = values <= 0
        if not given.any() or given.all():
            return surface
        judge = fit.outline_judge
        now = judge.shown(positive_part(vertices, faces, values))
        proposed = proposals(fit, now, (vertices, faces), self.config, steps)
        with steps.task("verdict"):
            closed = judge.shown((vertices, faces), like=now)
            before = closed.part(values)

            def judged(candidate: np.ndarray) -> np.ndarray:
                growth = grown(candidate <= 0, given, faces)
                logits = np.where(growth | given, candidate, np.abs(candidate))
                return close_rejected(logits, closed, judge, before, given)

            min_area = fit.config.topology.min_area
            growth = (further_openings(closed.mesh, values, proposed, min_area, judged) <= 0) & ~given
            if growth.any():
                moved = opened_at(surface, template, values, given | growth)
                growth &= _better(judge, closed, growth, fit.mesh(surface), fit.mesh(moved))
        steps.fact("rims_moved", bool(growth.any()))
        return opened_at(surface, template, values, given | growth) if growth.any() else surface


def _better(judge: Judge, template: Shown, growth: np.ndarray, before: Mesh, after: Mesh) -> np.ndarray:
    """(V,) at which vertices of a closed template the mesh after ``growth`` (V,) explains unseen views better
    than the one before. The rim that is drawn is not just that of the vertices that were judged."""
    (vertices, faces), around = template.mesh, growth
    for _ in range(_REDRAWN):
        around = spread(around, mesh_edges(faces)[0])
    place = places_of(growth, lobes(growth, faces))
    nearest = cKDTree(vertices[growth]).query(vertices)[1]
    place = np.where(around, place[growth][nearest], -1)
    verdict = judge.compare(judge.shown(before).whole, judge.shown(after).whole, place, template)
    return (verdict.gain > 0)[place] & around


def grown(opened: np.ndarray, given: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) which of the ``opened`` (V,) vertices are in parts beside the ``given`` (V,) ones."""
    new = opened & ~given
    if not new.any():
        return new
    place = places_of(new, lobes(new, faces))
    return new & parts_with(spread(given, mesh_edges(faces)[0]), place)[place]
