"""Poses: cameras are where the surface says that they are, if it says so clearly.

Poses from photographs are off by a pixel or so. The surface that all views agree on is not: each photograph
is laid on it, by the texture that the others show there and by its outline. Where that explains what it has
not been laid on by, later stages are given cameras that are corrected. Without masks all stay: texture tells
where cameras are beside each other, and would let all of them drift along the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from ..bounds import Between
from ..poses.alignment import Alignment
from ..poses.corrections import Corrections
from ..poses.evidence import Outline, Texture
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface


@dataclass(frozen=True)
class CamerasConfig:
    """Corrections of the cameras."""

    places: Annotated[int, Between(1)] = 20_000
    """Places of the surface whose texture is compared."""
    blur: Annotated[float, Between(0.5)] = 2.0
    """Blur of the images that texture is compared in, pixels: about how far poses may be off."""
    levels: Annotated[int, Between(1, 16)] = 2
    """How often the blur is halved, less one: as poses get better, finer texture tells more."""
    rounds: Annotated[int, Between(1)] = 3
    """Steps for each of them."""
    least: Annotated[float, Between(0)] = 0.2
    """Pixels by which half of the views have to move, or more: poses of renders move by a tenth."""


class Poses:
    """Corrects the cameras, if one half of each image foretells the other by that."""

    name = "poses"

    def __init__(self, config: CamerasConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with corrections of the cameras, or with none if they do not count."""
        config, targets = self.config, fit.scene.targets
        if not fit.pixels.has_alpha:
            return surface
        mesh = fit.scene.subject.surface_of(surface.fields).to_numpy()[:2]
        with steps.task(total=config.levels * config.rounds) as advance:
            distance = float(np.linalg.norm(fit.views.origins - mesh[0].mean(axis=0), axis=1).mean())
            alignment = Alignment(fit.views, distance)
            texture = Texture(mesh, targets, config.places, fit.cell(surface), fit.config.seed)
            outline = Outline(mesh, targets)
            verdict = None
            for level in range(config.levels):
                compare = texture.level(config.blur / 2**level, alignment.views)
                for _ in range(config.rounds):
                    now = alignment.views
                    kinds = compare(now), outline.evidence(now)
                    verdict = verdict or alignment.verdict(kinds)
                    alignment.step(kinds)
                    advance()
                moved = float(np.median(alignment.corrections.in_pixels(fit.views, texture.points)))
                kept = bool(verdict.accepted[0]) and moved > config.least
                if not kept:
                    break
        steps.fact("poses_verdict", verdict.facts() | {"pixels": round(moved, 3)})
        steps.fact("poses_kept", kept)
        if not kept:
            return surface
        steps.fact("poses", _facts(fit, alignment.corrections, texture.points))
        return replace(surface, poses=alignment.corrections.to_array(), settled=False)


def _facts(fit: Fit, corrections: Corrections, points: np.ndarray) -> dict[str, Any]:
    """How far cameras are corrected: in the median, and each."""
    degrees = np.degrees(np.linalg.norm(corrections.rotations, axis=1))
    columns = {
        "degrees": degrees,
        "shift": np.linalg.norm(corrections.shifts, axis=1),
        "pixels": corrections.in_pixels(fit.views, points),
    }
    medians = {f"median_{name}": round(float(np.median(values)), 4) for name, values in columns.items()}
    return medians | {
        "views": {
            name: {column: round(float(values[view]), 4) for column, values in columns.items()}
            for view, name in enumerate(fit.views.ids)
        }
    }
