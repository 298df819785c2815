"""Which openings of a template, and which islands in them, unseen views speak for."""

from __future__ import annotations

import numpy as np

from ...topology import equal_patches, mesh_edges, patch_sizes, spread, vertex_components
from ...triangles import positive_part
from ..judge import Judge, Mesh, Shown, places_of

#: Openings are parted where they are at most twice this many vertices wide.
_NECK = 2

#: Rounds in which openings are closed, each time those that are this near to the worst; in the last one all.
_CLOSINGS, _WORST = 5, 0.5


def close_rejected(logits: np.ndarray, template: Mesh, judge: Judge,
                   closed: Shown | None = None) -> np.ndarray:
    """Closes the openings through which unseen views are not explained better than without them.

    A hull that bulges over a fold, or a highlight, makes the views disagree on a vertex's radiance as a
    cap does, and may open there. But the sheet behind such a hole is farther from the truth than the hull,
    so the images disagree more. What hangs together by a narrow neck only is judged in parts. Through one
    opening others are seen, so the worst are closed first.

    Args:
        logits: (V,) opacity logits; surface where positive.
        template: the mesh that is opened.
        judge: of the fit.
        closed: the template as the judge shows it, if that is known.

    Returns:
        (V,) logits, those of rejected openings negated.
    """
    faces = template[1]
    opened = logits <= 0
    if not opened.any():
        return logits
    if opened.all():
        # Nothing at all explains no image.
        return -logits
    kept = opened
    if closed is None:
        closed = judge.shown(template)
    for closing in reversed(range(_CLOSINGS)):
        place = places_of(kept, _lobes(kept, faces))
        verdict = judge.compare(closed, _shown(judge, template, ~kept, logits), (template, place))
        worst = ~verdict.accepted
        # The worst first; all where none is worse but some are not surely better, and in the last round.
        if closing:
            loss = np.where(worst, np.maximum(-verdict.gain, 0), 0)
            worst &= loss >= _WORST * loss.max()
        kept = kept & ~worst[place]
        if not worst.any() or not kept.any():
            break
    return np.where(opened & ~kept, -logits, logits)


def open_rejected(logits: np.ndarray, template: Mesh, judge: Judge) -> np.ndarray:
    """Opens the islands in openings that unseen views do not speak for.

    A highlight on the inside of a bowl may be explained by a piece of the lid.

    Args:
        logits, template, judge: as of ``close_rejected``.

    Returns:
        (V,) logits, those of rejected islands negated.
    """
    faces = template[1]
    solid = logits > 0
    patch = equal_patches(solid, faces)
    part = vertex_components(faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(logits))[1]
    size, largest = patch_sizes(patch, part, solid)
    island = solid & (size < largest)
    if not island.any():
        return logits
    place = places_of(island, patch)
    without, present = (_shown(judge, template, chosen, logits) for chosen in (solid & ~island, solid))
    accepted = judge.compare(without, present, (template, place)).accepted
    return np.where(island & ~accepted[place], -logits, logits)


def _shown(judge: Judge, template: Mesh, solid: np.ndarray, logits: np.ndarray) -> Shown:
    """The part of a template that is solid, its rims where the logits have them."""
    vertices, faces = template
    return judge.shown(positive_part(vertices, faces, np.where(solid, np.abs(logits), -np.abs(logits))))


def _lobes(opened: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) ids of the connected patches of equal label, those that are open split at their necks."""
    edges, _ = mesh_edges(faces)
    here, there = np.concatenate([edges, edges[:, ::-1]]).T
    core = opened
    for _ in range(_NECK):
        core = ~spread(~core, edges)
    patch = equal_patches(opened, faces)
    # Patches without a core are whole.
    core = core | opened & (np.bincount(patch, core) == 0)[patch]
    lobe = np.where(core, 1 + vertex_components(edges[core[edges].all(axis=1)], len(opened))[1], 0)
    while True:
        front = (lobe[here] == 0) & (lobe[there] > 0) & opened[here]
        if not front.any():
            break
        np.maximum.at(lobe, here[front], lobe[there[front]])
    return np.where(opened, lobe, 1 + len(opened) + patch)
