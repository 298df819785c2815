"""Which openings of a template, and which islands in them, unseen views speak for."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np

from ..fields.smoothing import MeshDiffusion
from ..radiance.shown import Part, Shown
from ..template.caps import Recesses
from ..topology import equal_patches, lobes, mesh_components, mesh_edges, patch_sizes, spread
from .judge import Judge, places_of

#: Logits below which connected parts are proposed as openings, one after the other as long as some are
#: rejected: where gloss has made nearly all transparent, an opening still is so the most.
LEVELS = 0.0, -0.75, -1.5, -2.25

#: Rounds in which openings are closed; in the last one all that are rejected.
_CLOSINGS = 7

#: Places whose loss is this fraction of the largest are taken back together.
_WORST = 0.5

#: Lambda that smooths what single vertices tell along the mesh: a vertex is met by some hundred rays.
_SMOOTHING = 10.0


def close_rejected(
    logits: np.ndarray, template: Shown, judge: Judge, before: Part, given: np.ndarray | None = None
) -> np.ndarray:
    """Closes the openings through which unseen views are not explained better than without them.

    A hull that bulges over a fold, or a highlight, makes the views disagree on a vertex's radiance as a
    cap does, and may open there. But the sheet behind such a hole is farther from the truth than the hull,
    so the images disagree more. What hangs together by a narrow neck only is judged in parts. Through one
    opening others are seen, so the worst are closed first. Where a part is rejected, it is first closed
    where its own vertices speak against it, if that is not most of it, and judged again: an opening may run
    on into gloss beside it.

    What a justified opening grows by adds no loop: it only moves a rim, and of two rims the one counts that
    explains more, however little. Of the gilded hat's lid, pieces remained at its mouth whose opening gains
    0.14 to 0.35, 0.7 to 1.4 standard errors; what is surface in truth there loses 0.4 to 2.7.

    Args:
        logits: (V,) opacity logits; surface where positive.
        template: what is opened, closed.
        judge: of the fit.
        before: the template without these openings.
        given: (V,) openings that have been justified, which may grow; default: none.

    Returns:
        (V,) logits, those of rejected openings negated.
    """
    faces = template.mesh[1]
    given = np.zeros(len(logits), bool) if given is None else given
    opened = (logits <= 0) & ~given
    if not opened.any():
        return logits
    if (opened | given).all():
        # Nothing at all explains no image.
        return np.where(given, logits, -logits)
    beside = spread(given, mesh_edges(faces)[0])
    kept, trimmed, closed = opened, np.zeros_like(opened), 0
    for closing in reversed(range(_CLOSINGS)):
        place = places_of(kept, lobes(kept, faces))
        after = template.part(np.where(kept | given, -np.abs(logits), np.abs(logits)))
        verdict = replace(judge.compare(before, after, place), rejected=closed)
        grows = parts_with(beside, place)
        worst = ~(verdict.accepted | grows & np.isfinite(verdict.noise) & (verdict.gain > 0))
        # The worst first; all where none is worse but some are not surely better, and in the last round.
        if closing:
            loss = np.where(worst, np.maximum(-verdict.gain, 0), 0)
            worst &= worst_of(loss) if loss.any() else True
        rejected = kept & worst[place]
        if not rejected.any():
            break
        closed += np.count_nonzero(worst)
        anew = rejected & ~trimmed
        if closing and anew.any():
            anew &= _gains(judge, faces, before, after, anew) > 0
            # Crumbs of what is rejected are chance: there are so many of them.
            share = np.bincount(place[kept], anew[kept]) / np.bincount(place[kept])
            anew &= share[place] > 0.5
        else:
            anew[:] = False
        kept = kept & (~rejected | anew)
        trimmed |= rejected
        if not kept.any():
            break
    return np.where(opened & ~kept, -logits, logits)


def parts_with(chosen: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(P,) which places, of (V,) vertices, -1 where in none, have a chosen (V,) one.

    >>> parts_with(np.array([True, False, True]), np.array([-1, 0, 1])).tolist()
    [False, True]
    """
    told = place >= 0
    return np.bincount(place[told], chosen[told]) > 0


def worst_of(loss: np.ndarray) -> np.ndarray:
    """(P,) which places to take back first, of what each loses: what is seen through one changes the others.

    >>> worst_of(np.array([0.1, 1.0, 0.6])).tolist(), worst_of(np.array([-0.1, 0.0])).tolist()
    ([False, True, True], [False, False])
    """
    return (loss > 0) & (loss >= _WORST * loss.max())


def close_shallow(logits: np.ndarray, template: Shown, judge: Judge, thickness: float) -> np.ndarray:
    """Closes the openings that do not explain unseen views surely better than lids on thin parts' other side.

    A hull is up to about a cell outside of the surface. Through a hole in one side of a thin part, such as a
    leaf, images see the other side, which may be nearer to where the sheet is. But both are the same sheet,
    and which of them it keeps is told when they have moved.

    Args:
        logits, template, judge: as of ``close_rejected``.
        thickness: of thin parts, at most, world units.

    Returns:
        (V,) logits, those of such openings negated.
    """
    opened = logits <= 0
    if not opened.any():
        return logits
    vertices, faces = template.mesh
    place = places_of(opened, lobes(opened, faces))
    lids = judge.shown((Recesses(vertices, faces, place).on_other_sides(thickness), faces), like=template)
    surely = judge.compare(lids.part(np.abs(logits)), template.part(logits), place, template).accepted
    return np.where(opened & ~surely[place], -logits, logits)


def islands(solid: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(V,) which ``solid`` (V,) vertices of a template are on islands, smaller than what else hangs together
    on the same piece, and (V,) ids of what hangs together.

    >>> islands(np.array([True, False, True, True]), np.array([[0, 1, 1], [1, 2, 3]]))[0].tolist()
    [True, False, False, False]
    """
    patch = equal_patches(solid, faces)
    piece = mesh_components(faces, len(solid))
    size, largest = patch_sizes(patch, piece, solid)
    return solid & (size < largest), patch


def open_rejected(
    logits: np.ndarray, template: Shown, judge: Judge, given: np.ndarray | None = None
) -> np.ndarray:
    """Opens the islands in openings that unseen views do not speak for.

    A highlight on the inside of a bowl may be explained by a piece of the lid.

    Args:
        logits, template, judge: as of ``close_rejected``.
        given: (V,) islands that have been justified; default: none.

    Returns:
        (V,) logits, those of rejected islands negated.
    """
    solid = logits > 0
    island, patch = islands(solid, template.mesh[1])
    if given is not None:
        island &= ~given
    if not island.any():
        return logits
    place = places_of(island, patch)
    without, present = (
        template.part(np.where(chosen, np.abs(logits), -np.abs(logits)))
        for chosen in (solid & ~island, solid)
    )
    accepted = judge.compare(without, present, place).accepted
    return np.where(island & ~accepted[place], -logits, logits)


def _gains(judge: Judge, faces: np.ndarray, before: Part, after: Part, chosen: np.ndarray) -> np.ndarray:
    """(V,) what each ``chosen`` vertex tells of a change, smoothed along the template; up to a factor."""
    count = len(chosen)
    place = places_of(chosen, np.arange(count))
    gain = np.where(chosen, judge.compare(before, after, place).gain[place], 0)
    smooth = MeshDiffusion(faces, count, _SMOOTHING)
    return smooth(mi.Float(gain.astype(np.float32))).numpy()
