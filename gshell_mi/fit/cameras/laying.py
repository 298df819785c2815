"""Photographs laid on a surface: coarse texture first, then finer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ...bounds import Between
from ...calibration.evidence import Evidence, Outline, Texture
from ...targets import Target
from ...views import PinholeViews
from ..judge import Verdict
from .alignment import Alignment


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
    """Pixels by which the views that may move have to move, in the root mean square: poses of renders move by
    a tenth."""


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
        self.points = self._texture.points

    def verdicts(self) -> tuple[Verdict, Verdict]:
        """Whether corrections are worth it: those of all cameras, and that of each."""
        return self.alignment.verdicts(self._kinds(self._comparison(0)))

    def level(self, number: int, advance: Callable[[], object] = lambda: None) -> None:
        """The steps of a level; levels come in their order.

        Args:
            number: of the level, from 0 on: how often the blur is halved.
            advance: is told of each step.
        """
        texture = self._comparison(number)
        for _ in range(self._config.rounds):
            self.alignment.step(self._kinds(texture))
            advance()

    def _comparison(self, number: int) -> Callable[[PinholeViews], list[Evidence]]:
        """Of texture, at a level."""
        return self._texture.level(self._config.blur / 2**number, self.alignment.views)

    def _kinds(self, texture: Callable[[PinholeViews], list[Evidence]]) -> list[list[Evidence]]:
        """Evidence where cameras are now."""
        return [texture(self.alignment.views), self._outline.evidence(self.alignment.views)]
