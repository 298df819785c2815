"""The rounds of the photometric refinement, each judged by views that it does not see.

The first moves whole parts calmly; the second, "folds", hollows out pleats. Neither counts unless one
radiance explains the unseen views the better for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ...scene import FitScene
from ...views import PinholeViews
from ..bookkeeping.bookkeeping import Bookkeeping
from ..config import FitConfig
from ..ghost.ghost_template import GhostTemplate
from ..ghost.pixels import PixelPool
from ..ghost.radiance_ghost import RadianceGhost
from .descent import Descent
from .outlines import Outlines
from .refinement import PhotometricRefinement


@dataclass(frozen=True)
class Moved:
    """Where the template's vertices are, and what was seen there.

    Attributes:
        stage: the round that has moved them; "start" if none has.
        positions: (V, 3) world positions.
        radiance: (V, 3) of the outer side.
        error: mean image loss of the unseen views.
    """

    stage: str
    positions: np.ndarray
    radiance: np.ndarray
    error: float


class RefinementRounds:
    """Moves a template in rounds, and goes on in the round that the checkpoint is in.

    Args:
        template: with its opacity decided.
        fit: the scene with its targets.
        known, unknown: pixels to learn from, and those of the unseen views.
        config: ``refinement_*`` and ``folds_*`` fields.
        books: runs the steps.
    """

    def __init__(self, template: GhostTemplate, fit: FitScene, views: PinholeViews, known: PixelPool,
                 unknown: PixelPool, config: FitConfig, books: Bookkeeping):
        self.template, self.unknown, self.config, self.books = template, unknown, config, books
        self._cell = fit.subject.cell_size
        self._ghost = RadianceGhost(template.start, template.faces, views, known, config, glossy=True)
        self._outlines = None
        if known.has_alpha:
            alphas = [target.rgba[..., 3] for target in fit.targets]
            self._outlines = Outlines(views, alphas, template.faces, template.solid)

    def run(self, state: Mapping[str, np.ndarray]) -> list[Moved]:
        """Runs the rounds; returns what has come of them and counts, the best first."""
        config = self.config
        if self.books.checkpoint.stage == "refinement":
            start = self._standing("start", self.template.start)
            first = self._moved("refinement", start.positions, config, state)
            if first.error >= config.refinement_gain * start.error:
                return []
            if not config.folds_iterations:
                return [first]
            state = dict(state) | {"positions": first.positions}
            self.books.enter("folds", **state)
        else:
            first = self._standing("refinement", state["positions"])
        second = self._moved("folds", first.positions, config.for_folds(), state, config.folds_descent)
        if second is None:
            return [first]
        return [second, first] if second.error < config.folds_gain * first.error else [first, second]

    def _standing(self, stage: str, positions: np.ndarray) -> Moved:
        """The template at rest, with a radiance fitted anew."""
        self._ghost.move(mi.Float(positions.ravel()))
        self._ghost.refit_anew(self.template.solid)
        return self._seen(stage, positions)

    def _moved(self, stage: str, positions: np.ndarray, config: FitConfig, state: Mapping[str, np.ndarray],
               descent: float | None = None) -> Moved | None:
        """The template after a round that starts from ``positions`` and the radiance of now; None if its
        image error has not fallen below the fraction ``descent``."""
        refinement = PhotometricRefinement(self._ghost, positions, self.template.faces, self._outlines,
                                           self._cell, config)
        optimizers = {"ghost": self._ghost.optimizer, "refinement": refinement.optimizer}
        count = config.refinement_iterations
        if descent is None:
            self.books.iterate(stage, count, refinement, optimizers, state)
        else:
            watched = Descent(refinement, count, descent, state)
            self.books.iterate(stage, count, watched, optimizers, state, watched.state, watched.stalled)
            if watched.stalled(count):
                return None
        with self.books.timed(stage):
            self._ghost.move(mi.Float(refinement.positions().ravel()))
            self._ghost.refit(self.template.solid)
            return self._seen(stage, refinement.positions())

    def _seen(self, stage: str, positions: np.ndarray) -> Moved:
        radiance, _ = self._ghost.radiance()
        return Moved(stage, positions, radiance, self._ghost.unexplained(self.unknown))
