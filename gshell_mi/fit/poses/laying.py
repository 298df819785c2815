"""Photographs laid on a surface: coarse texture first, then finer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ...targets import Target
from ...views import PinholeViews
from ..bounds import Between
from ..judge import Verdict
from .alignment import Alignment
from .evidence import Outline, Texture


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
    """Pixels by which views have to move, in the root mean square: poses of renders move by a tenth."""


class Laying:
    """Lays photographs on a surface.

    Args:
        mesh: vertices (V, 3) and faces (F, 3), world units.
        views: the cameras.
        targets: the photographs, with masks.
        config: the settings.
        cell: side of a lattice cell, world units.
        seed: of the places that are compared.
        moving: (N,) which cameras may move; default: all.

    Attributes:
        points: (P, 3) these places.
        alignment: what was found so far.
    """

    def __init__(
        self,
        mesh: tuple[np.ndarray, np.ndarray],
        views: PinholeViews,
        targets: list[Target],
        config: CamerasConfig,
        *,
        cell: float,
        seed: int,
        moving: np.ndarray | None = None,
    ):
        distance = float(np.linalg.norm(views.origins - mesh[0].mean(axis=0), axis=1).mean())
        self.alignment = Alignment(views, distance, moving)
        self._texture = Texture(mesh, targets, config.places, cell, seed)
        self._outline, self._config = Outline(mesh, targets), config
        self._verdict: Verdict | None = None
        self.points = self._texture.points

    def level(self, number: int, advance: Callable[[], object] = lambda: None) -> Verdict:
        """The steps of a level; levels come in their order.

        Args:
            number: of the level, from 0 on: how often the blur is halved.
            advance: is told of each step.

        Returns:
            Whether corrections are worth it, as is told before the first step of the first level.
        """
        alignment, verdict = self.alignment, self._verdict
        texture = self._texture.level(self._config.blur / 2**number, alignment.views)
        for _ in range(self._config.rounds):
            kinds = texture(alignment.views), self._outline.evidence(alignment.views)
            verdict = verdict or alignment.verdict(kinds)
            alignment.step(kinds)
            advance()
        assert verdict
        self._verdict = verdict
        return verdict
