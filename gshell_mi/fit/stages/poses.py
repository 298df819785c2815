"""Poses: cameras are where the surface says that they are, if it says so clearly.

Poses from photographs are off by a pixel or so. The surface that all views agree on is not: each photograph
is laid on it, by the texture that the others show there and by its outline. Where that explains what it has
not been laid on by, later stages are given cameras that are corrected. Without masks all stay: texture tells
where cameras are beside each other, and would let all of them drift along the surface.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...calibration.corrections import Corrections
from ...views import PinholeViews
from ..cameras.laying import CamerasConfig, Laying
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface


class Poses:
    """Corrects the cameras, if one half of each image foretells the other by that.

    All are, if that is so in the mean over the views, and else those of which it is.

    Args:
        name: of the stage.
        config: its settings.
        last: whether the surface stays as it is. Then cameras have to lie on it; else, in the mean, they stay
            where they are, and what all have in common is left to the surface.
    """

    def __init__(self, name: str, config: CamerasConfig, *, last: bool = False):
        self.name, self.config, self._last = name, config, last

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with corrections of the cameras, or as it was if they do not count."""
        config, mesh = self.config, fit.mesh(surface)
        if not (fit.pixels.has_alpha and len(mesh[1])):
            return surface
        with steps.task("verdict"):
            laying = Laying(
                mesh, fit.views, fit.scene.targets, config, cell=fit.cell(surface), seed=fit.config.seed
            )
            every, each = laying.verdicts()
        corrections, kept, told = laying.alignment.corrections, False, every.facts()
        for moving in (np.full(len(fit.views), every.accepted[0]), each.accepted):
            if not kept and moving.any():
                corrections, moved = self._laid(fit, laying, moving, steps)
                kept = moved > config.least
                told |= {"pixels": round(moved, 3), "cameras": int(moving.sum())}
        steps.fact(f"{self.name}_verdict", told)
        steps.fact(f"{self.name}_kept", kept)
        if not kept:
            return surface
        given = fit.views
        if surface.poses is not None:
            before = Corrections.from_array(surface.poses)
            corrections, given = corrections.after(before), before.inverse().views(given)
        steps.fact("poses", _facts(given, corrections, laying.points))
        return replace(surface, poses=corrections.to_array(), settled=False)

    def _laid(self, fit: Fit, laying: Laying, moving: np.ndarray, steps: Steps) -> tuple[Corrections, float]:
        """Corrections of (N,) some cameras, and the root mean square of the pixels that they move by."""
        laying.alignment.start(moving)
        corrections, moved = laying.alignment.corrections, 0.0
        with steps.task(total=self.config.levels * self.config.rounds) as advance:
            for level in range(self.config.levels):
                laying.level(level, advance)
                corrections = laying.alignment.found if self._last else laying.alignment.corrections
                pixels = corrections.in_pixels(fit.views, laying.points)[moving]
                moved = float(np.sqrt((pixels**2).mean()))
                if moved <= self.config.least:
                    break
        return corrections, moved


def _facts(given: PinholeViews, corrections: Corrections, points: np.ndarray) -> dict[str, Any]:
    """How far cameras that were given are corrected: in the median, and each."""
    degrees = np.degrees(np.linalg.norm(corrections.rotations, axis=1))
    columns = {
        "degrees": degrees,
        "shift": np.linalg.norm(corrections.shifts, axis=1),
        "pixels": corrections.in_pixels(given, points),
    }
    medians = {f"median_{name}": round(float(np.median(values)), 4) for name, values in columns.items()}
    return medians | {
        "views": {
            name: {column: round(float(values[view]), 4) for column, values in columns.items()}
            for view, name in enumerate(given.ids)
        }
    }
