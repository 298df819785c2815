"""Which openings of a template, and which islands in them, the images justify."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...topology import equal_patches, mesh_edges, patch_sizes, spread, vertex_components

#: Openings are parted where they are at most twice this many vertices wide.
_NECK = 2

#: Openings below this fraction of the template's vertices have to be justified the better, by this factor,
#: and by every choice of pixels: a bulge beside a handle is small, and few rays tell of a small opening.
_SMALL, _STRICTER = 0.05, 0.725

#: Rounds in which openings are closed, each time those that are this near to the worst; in the last one all.
_CLOSINGS, _WORST = 5, 0.5


def close_rejected(logits: np.ndarray, faces: np.ndarray, error: Callable[[np.ndarray], np.ndarray],
                   gain: float) -> np.ndarray:
    """Closes the openings through which the images are not explained better than without them.

    A hull that bulges over a fold, or a highlight, makes the views disagree on a vertex's radiance as a
    cap does, and may open there. But the sheet behind such a hole is farther from the truth than the hull,
    so the images disagree more. Where a hull bulges into daylight, beside a handle, the daylight alone would
    justify a small opening; pixels that are wholly covered do not. The inside of a skirt may be so dark that
    daylight, seen through its waist, is all that speaks for its hem.

    What hangs together by a narrow neck only is judged in parts. Through one opening others are seen, so the
    least justified are closed first.

    Args:
        logits: (V,) opacity logits; surface where positive.
        faces: (F, 3) of the template.
        error: maps (V,) opaque or not to the image error through each vertex, (k, V) for several choices of
            pixels, the first of which are all.
        gain: an opening stays if the error through it is less than this fraction of the closed one's; small
            ones need a better reason.

    Returns:
        (V,) logits, those of unjustified openings negated.
    """
    opened = logits <= 0
    if not opened.any():
        return logits
    closed_error = error(np.ones_like(opened))
    for closing in range(_CLOSINGS):
        patch = _lobes(opened, faces)
        ratios = _ratios(closed_error, error(~opened), patch)
        small = np.bincount(patch) < _SMALL * len(opened)
        # At a gain of 0 nothing is justified.
        excess = np.where(small, ratios.max(axis=0) / _STRICTER, ratios[0]) / max(gain, 1e-30)
        excess[np.bincount(patch, opened) == 0] = 0
        if not (excess > 1).any():
            break
        # At last there is no time for more.
        worst = excess > (1 if closing == _CLOSINGS - 1 else max(1, _WORST * excess.max()))
        opened &= ~worst[patch]
    return np.where((logits <= 0) & ~opened, -logits, logits)


def open_rejected(logits: np.ndarray, faces: np.ndarray, error: Callable[[np.ndarray], np.ndarray],
                  gain: float) -> np.ndarray:
    """Opens the islands in openings without which the images are explained about as well.

    A highlight on the inside of a bowl may be explained by a piece of the lid.

    Args:
        logits, faces, error: as of ``close_rejected``.
        gain: an island stays if the error with it is less than this fraction of that without.

    Returns:
        (V,) logits, those of unjustified islands negated.
    """
    solid = logits > 0
    patch = equal_patches(solid, faces)
    part = vertex_components(faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(logits))[1]
    size, largest = patch_sizes(patch, part, solid)
    island = solid & (size < largest)
    if not island.any():
        return logits
    ratio = _ratios(error(solid), error(solid & ~island), patch).max(axis=0)
    return np.where(island & (gain * ratio[patch] < 1), -logits, logits)


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


def _ratios(before: np.ndarray, after: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """(k, P) factors by which (k, V) errors change in each patch."""
    sums = [np.array([np.bincount(patch, values) for values in errors]) for errors in (before, after)]
    return sums[1] / np.maximum(sums[0], 1e-30)
