"""Refinement and folds: the template's vertices move to where one radiance explains all images.

The first round moves whole parts calmly; the second, "folds", hollows out pleats. Each is judged by views
whose colours it does not see: it does not count unless one radiance explains them the better for it. Outlines
of all views count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import mitsuba as mi
import numpy as np

from ...radiance.surface_radiance import SurfaceRadiance
from ...template.outlines import Outlines
from ...triangles import positive_part
from ..appearance import training_radiance
from ..refinement.early_stopping import EarlyStopping
from ..refinement.refinement import PhotometricRefinement
from ..runner import Steps
from ..stage import Fit
from ..surface import Moved, Surface
from ..template import Template, template_of


@dataclass(frozen=True)
class RefinementConfig:
    """Photometric refinement: whole parts."""

    iterations: int = 400
    """Steps; 0 keeps the shape as it is."""
    lr: float = 0.12
    """Largest movement of a vertex per step, in cells; falls to 0 like a cosine."""
    smoothing: float = 95.0
    """Lambda of the Sobolev gradient on the template when it starts to move, in square cells: whole parts
    move first."""
    detail: float = 34.0
    """Lambda at the end; falls geometrically. Nothing is smoothed if either is 0."""
    radiance_lr: float = 0.05
    """Adam's step for the radiance meanwhile."""
    outline: float = 0.001
    """Weight of the squared distance, in cells, between silhouettes and masks; falls to half."""
    descent: float | None = None
    """It ends after a quarter of its steps unless the image error is below this fraction of what it was at
    first; default: it goes on."""


@dataclass(frozen=True)
class FoldsConfig(RefinementConfig):
    """Photometric refinement once more: details, which move farther."""

    iterations: int = 440
    lr: float = 0.3
    smoothing: float = 34.0
    detail: float = 11.0
    descent: float | None = 0.98


class Refinement:
    """Moves the template's vertices once; the fields stay until ``Revoxelise``.

    Args:
        name: of the round.
        config: its settings.
        first: whether it starts from the template. If not, it starts from what the round before has made of
            it, and does nothing if that has not counted.
    """

    def __init__(self, name: str, config: RefinementConfig, *, first: bool):
        self.name, self.config, self.first = name, config, first

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with one more entry in ``moved`` if that counts: before the others if it is better."""
        surface = surface.on_grid(fit.lattices.late.grid)
        if not self.config.iterations or not (self.first or surface.moved):
            return surface
        steps.fact(f"{self.name}_kept", False)
        template = template_of(fit.scene.subject, surface)
        start, appearance = template.start, training_radiance(fit, template)
        if self.first:
            appearance.refit_anew(template.solid)
        else:
            start = surface.moved[0].positions
            appearance.take_over(start, surface.moved[0].fitted)
        after = self._moved(appearance, template, start, fit, steps, fit.cell(surface))
        if after is None:
            return surface
        with steps.task("verdict"):
            meshes = [positive_part(at, template.faces, template.logits) for at in (start, after.positions)]
            verdict, unseen = (judge.decide(*meshes) for judge in (fit.judge, fit.validation_judge))
        steps.fact(f"{self.name}_verdict", verdict.facts() | {"unseen_gain": round(float(unseen.gain[0]), 5)})
        # All views tell whether it is more than noise; those whose colours it does not know, that it is no
        # gloss.
        accepted = verdict.accepted[0] and unseen.gain[0] > 0
        return replace(surface, moved=(after, *surface.moved)) if accepted else surface

    def _moved(
        self,
        appearance: SurfaceRadiance,
        template: Template,
        positions: np.ndarray,
        fit: Fit,
        steps: Steps,
        cell: float,
    ) -> Moved | None:
        """The template after the steps; None if they get nowhere."""
        outlines = None
        if fit.training.has_alpha:
            outlines = Outlines(fit.masks, fit.scene.targets, template.faces, template.solid)
        refinement = PhotometricRefinement(
            appearance, positions, template.faces, outlines, cell, self.config, fit.config.seed
        )
        run = partial(
            steps.run,
            count=self.config.iterations,
            optimizers={"radiance": appearance.optimizer, "refinement": refinement.optimizer},
        )
        if self.config.descent is None:
            run(refinement)
        else:
            watched = EarlyStopping(refinement, self.config.iterations, self.config.descent, steps.kept)
            run(watched, state=watched.state, stalled=watched.stalled)
            if watched.stalled(self.config.iterations):
                return None
        positions = refinement.positions()
        appearance.move(mi.Float(positions.ravel()))
        appearance.refit(template.solid)
        return Moved(self.name, positions, appearance.radiance()[0], appearance.fitted())
