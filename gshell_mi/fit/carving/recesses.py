"""Recesses: what lies behind a template's surface need not be as far as its other side.

Where the template fills a fold, or the space below a rim, the radiance with opacity fades as it does at an
opening. How deep it is, if at all, unseen views tell.
"""

from __future__ import annotations

import numpy as np

from ...radiance.shown import Shown
from ...template.caps import Recesses, facing_one_way
from ...template.msdf import clean_opacity
from ...template.revoxelise import HELD
from ...topology import lobes
from ..acceptance import LEVELS
from ..judge import Judge, Verdict, places_of
from ..stage import Fit


def sunk(fit: Fit, template: Shown, values: np.ndarray, proposed: np.ndarray, cell: float) -> np.ndarray:
    """(V, 3) vertices of the template, moved deeper where unseen views are explained better so.

    Where a recess is filled, such as a fold or the gap between a hat's crown and its brim, the radiance fades
    as it does at an opening; but what is seen through it is as wrong as before.

    Args:
        fit: the views.
        template: closed.
        values: (V,) negative at its openings.
        proposed: (V,) opacity logits.
        cell: side of a lattice cell, world units.
    """
    (vertices, faces), judge = template.mesh, fit.outline_judge
    for level in LEVELS:
        logits = clean_opacity(
            np.where(values > 0, proposed - level, values), vertices, faces, fit.config.topology.min_area
        )
        chosen = (logits <= 0) & (values > 0)
        if not chosen.any():
            continue
        place = places_of(chosen, lobes(chosen, faces))
        place = places_of(chosen, facing_one_way(vertices, faces, place))
        recesses = Recesses(vertices, faces, place, HELD * cell)
        depth = _best_depth(judge, template, recesses, values, place, cell)
        if depth.any():
            vertices = recesses.at(depth)
            template = judge.shown((vertices, faces), like=template)
    return vertices


def _best_depth(
    judge: Judge, template: Shown, recesses: Recesses, values: np.ndarray, place: np.ndarray, cell: float
) -> np.ndarray:
    """(P,) depth of the recess that explains unseen views best, 0 where none does surely better than nothing;
    ``values`` (V,) are negative at openings."""
    now, depths, verdicts = template.part(values), recesses.depths(cell), []
    rises = np.full(int(place.max()) + 1, True)
    best = np.zeros(len(rises))
    for depth in depths:
        shown = judge.shown((recesses.at(depth), template.mesh[1]), like=template)
        verdicts.append(judge.compare(now, shown.part(values), place, template))
        rises &= verdicts[-1].gain > best
        if not rises.any():
            break
        best = np.maximum(best, verdicts[-1].gain)
    return _best(depths, verdicts)


def _best(depths: list[float], verdicts: list[Verdict]) -> np.ndarray:
    """(P,) which of the depths gains most at each place, of those accepted; 0 where none is. The verdicts are
    on the first ones, for all places each."""
    tried = Verdict.together(verdicts)
    gain = np.where(tried.accepted, tried.gain, 0).reshape(len(verdicts), -1)
    return np.where(gain.max(axis=0) > 0, np.array(depths)[gain.argmax(axis=0)], 0)


def recess_depths(
    judge: Judge,
    template: Shown,
    recesses: Recesses,
    closed: np.ndarray,
    opened: np.ndarray,
    place: np.ndarray,
    cell: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Recesses at the places of new openings: what lies behind a surface need not be nothing.

    Where the surface fills a recess, whatever lies deeper explains more than it does, and a hole is deep.

    Args:
        judge: of the fit.
        template: closed.
        recesses: of it.
        closed, opened: (V,) values, negative at openings, without and with the new ones.
        place: (V,) of the new openings, P places, -1 elsewhere.
        cell: side of a lattice cell, world units.

    Returns:
        (P,) depth of the recess that explains unseen views best, 0 where none does surely better than the
        surface; (P,) by how much at least an opening explains them better than a recess does.
    """
    now, holes = template.part(closed), template.part(opened)
    depths, verdicts, openings = recesses.depths(cell), [], []
    for depth in depths:
        recess = judge.shown((recesses.at(depth), template.mesh[1]), like=template).part(closed)
        verdicts.append(judge.compare(now, recess, place, template))
        openings.append(judge.compare(recess, holes, place, template).gain)
    return _best(depths, verdicts), np.min(openings, axis=0)
