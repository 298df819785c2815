"""Occlusion: what a few masks deny, and all others show, is hidden in these views and not absent.

A stand before the rim, a hand, a mask that wavers: each carves the hull right through, as a hull believes
every mask. So it is asked whether a hull that does not believe a few of them explains the views better, place
by place, and the judge decides. Where it does, the pixels that deny the place tell nothing in what follows.
Gaps that few views look through stay open: all other views would have to see what is not there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy.spatial import cKDTree

from ...bounds import Between
from ...compat import mesh_scene
from ...fields.mask_distances import MaskDistances
from ...packed_pixels import packed
from ...radiance.shown import Mesh
from ...topology import lobes
from ..judge import places_of
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface
from ..template import template_of
from .hull import hulls_of

#: A hull that believes less is proposed where it is larger by this many cells: masks are not exact.
_THICKER = 1.2

#: Places of fewer vertices than this, a square of some cells, are not judged.
_FEWEST = 20


@dataclass(frozen=True)
class OcclusionConfig:
    """Pixels whose masks deny what others see."""

    most: Annotated[float, Between(0, 0.5)] = 0.1
    """Share of the views whose masks may be wrong at a place; 0 believes all of them. A stand that hides a
    rim from the front does so in a tenth."""
    levels: Annotated[int, Between(1, 16)] = 3
    """Proposals, each of which disbelieves twice as many masks as the one before."""


class Occlusion:
    """Finds the pixels that tell nothing of the object though their masks say that it is not there."""

    name = "occlusion"

    def __init__(self, config: OcclusionConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with the pixels to ignore."""
        config, count = self.config, len(fit.views)
        shares = [config.most / 2**level for level in reversed(range(config.levels))]
        disbelieved = sorted({round(share * count) for share in shares} - {0})
        if not (fit.pixels.has_alpha and disbelieved):
            return surface
        ignored = [np.zeros(alpha.shape, bool) for alpha in fit.alphas]
        cell = fit.lattices.early.spacing * fit.scene.subject.length_scale
        facts: dict[str, list[float | None]] = {"gain": [], "noise": []}
        with steps.task():
            before, *larger = _meshes(fit, ignored, [0, *disbelieved])
            shown = fit.judge.shown(before)
            for level in range(len(disbelieved) if len(before[1]) else 0):
                after = larger[level]
                place = _larger(before, after, cell)
                if (place < 0).all():
                    continue
                hull = fit.judge.shown(after, like=shown)
                verdict = fit.judge.compare(shown.whole, hull.whole, place, hull)
                for name, values in verdict.facts().items():
                    facts[name] += values
                chosen = (place >= 0) & verdict.accepted[place]
                if chosen.any():
                    ignored = [
                        already | new
                        for already, new in zip(ignored, _denying(fit, after, chosen), strict=True)
                    ]
                    before, *larger = _meshes(fit, ignored, [0, *disbelieved])
                    shown = fit.judge.shown(before)
        views = sum(bool(pixels.any()) for pixels in ignored)
        steps.fact("occlusion_verdict", facts)
        steps.fact("occluded_views", views)
        return replace(surface, ignored=packed(ignored)) if views else surface


def _meshes(fit: Fit, ignored: list[np.ndarray], disbelieved: list[int]) -> list[Mesh]:
    """Hulls that do not believe so many masks, without the pixels that are ignored."""
    masks = fit.masks
    if any(pixels.any() for pixels in ignored):
        masks = MaskDistances(
            fit.views, [np.maximum(*each) for each in zip(fit.alphas, ignored, strict=True)]
        )
    return [template_of(fit.scene.subject, hull).closed for hull in hulls_of(fit, masks, disbelieved)]


def _larger(hull: Mesh, larger: Mesh, cell: float) -> np.ndarray:
    """(V,) places of the larger hull's vertices where it is clearly larger, from 0; -1 elsewhere."""
    chosen = cKDTree(hull[0]).query(larger[0])[0] > _THICKER * cell
    place = places_of(chosen, lobes(chosen, larger[1]))
    size = np.bincount(place[chosen], minlength=1)
    return places_of(chosen & (size[place] >= _FEWEST), place)


def _denying(fit: Fit, mesh: Mesh, chosen: np.ndarray) -> Iterator[np.ndarray]:
    """Of each view, (height, width) pixels that see a chosen vertex of a mesh first, and whose mask says that
    nothing is there."""
    scene = mesh_scene(*mesh)
    for view, alpha in enumerate(fit.alphas):
        found = scene.ray_intersect_preliminary(fit.views.pixel_rays(view), coherent=True)
        hit = found.is_valid().numpy()
        corner = mesh[1][np.where(hit, found.prim_index.numpy(), 0), 0]
        yield (hit & chosen[corner]).reshape(alpha.shape) & (alpha < 0.5)
