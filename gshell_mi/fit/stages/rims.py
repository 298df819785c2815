"""Rims: openings grow to where the finished surface ends.

What an opening grows by is no discrete change: its rim moves, and no loop comes or goes. But steps of an
optimiser move it by a cell or so, and pieces of the lid that was in a mouth are larger. On the surface that
the last steps leave, the same radiance with opacity and the same judge see where such pieces explain less
than what is behind them.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ...extraction.surface_mesh import SurfaceMesh
from ...radiance.shown import Mesh
from ...topology import lobes, mesh_edges, spread, topology
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
        judge = fit.judge
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
                denied = _denied(fit.outline_judge, closed.mesh, growth, fit.mesh(surface), fit.mesh(moved))
                growth = _with_as_many_loops(fit, surface, template, values, growth & ~denied)
        steps.fact("rims_moved", bool(growth.any()))
        return opened_at(surface, template, values, given | growth) if growth.any() else surface


def _denied(judge: Judge, template: Mesh, growth: np.ndarray, before: Mesh, after: Mesh) -> np.ndarray:
    """(V,) at which vertices of a closed template the mesh after ``growth`` (V,) surely explains unseen views
    worse than the one before. The rim that is drawn is not just that of the vertices that were judged, and
    of a strip along a rim only pixels at outlines tell."""
    (vertices, faces), around = template, growth
    for _ in range(_REDRAWN):
        around = spread(around, mesh_edges(faces)[0])
    place = places_of(growth, lobes(growth, faces))
    nearest = cKDTree(vertices[growth]).query(vertices)[1]
    place = np.where(around, place[growth][nearest], -1)
    verdict = judge.compare(judge.shown(before).whole, judge.shown(after).whole, place, judge.shown(template))
    return verdict.reversed.accepted[place] & around


def _with_as_many_loops(
    fit: Fit, surface: Surface, template: SurfaceMesh, values: np.ndarray, growth: np.ndarray
) -> np.ndarray:
    """(V,) growth (V,) of the openings of a template's (V,) values that leaves as many loops: part by part,
    the largest first, what becomes a hole beside them, or makes one of two, is left out."""

    def loops(opened: np.ndarray) -> int:
        return topology(*fit.mesh(opened_at(surface, template, values, opened))).boundary_loops

    kept = given = values <= 0
    count = loops(given)
    if not growth.any() or loops(given | growth) == count:
        return growth
    place = places_of(growth, lobes(growth, template.to_numpy()[1]))
    for part in np.argsort(-np.bincount(place[growth])):
        wider = kept | (place == part)
        kept = wider if loops(wider) == count else kept
    return kept & ~given


def grown(opened: np.ndarray, given: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) which of the ``opened`` (V,) vertices are in parts beside the ``given`` (V,) ones."""
    new = opened & ~given
    if not new.any():
        return new
    place = places_of(new, lobes(new, faces))
    return new & parts_with(spread(given, mesh_edges(faces)[0]), place)[place]
