"""What a stage of the fit is: something that makes a better surface of a surface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import mitsuba as mi
import numpy as np

from ..scene import FitScene
from ..views import PinholeViews
from .bookkeeping.observer import Preview
from .lattices import Lattices
from .radiance.pixels import PixelPool
from .surface import Surface

if TYPE_CHECKING:
    from .config import FitConfig

#: Every eighth view is held out: it judges what the others are fitted to.
_HOLD_OUT = 8


@dataclass(frozen=True)
class Fit:
    """What all stages may read.

    Attributes:
        scene: with its targets. Only the joint stage changes its shape.
        config: the settings.
        lattices: that stages work on.
    """

    scene: FitScene
    config: FitConfig
    lattices: Lattices

    @cached_property
    def views(self) -> PinholeViews:
        """The cameras."""
        return PinholeViews.from_sensors(self.scene.sensors)

    @cached_property
    def alphas(self) -> list[np.ndarray]:
        """Coverage of each view, (height, width)."""
        return [target.rgba[..., 3] for target in self.scene.targets]

    @cached_property
    def pixels(self) -> PixelPool:
        """The pixels of all views."""
        return PixelPool(self.views, self.scene.targets)

    @cached_property
    def training(self) -> PixelPool:
        """The pixels of the views that are not held out."""
        every = np.arange(len(self.views))
        chosen = np.setdiff1d(every, every[::_HOLD_OUT]) if len(every) > 1 else every
        return PixelPool(self.views, self.scene.targets, chosen)

    @cached_property
    def held_out(self) -> PixelPool:
        """The pixels of the views that judge."""
        return PixelPool(self.views, self.scene.targets, np.arange(len(self.views))[::_HOLD_OUT])

    def cell(self, surface: Surface) -> float:
        """Side of a cell of a surface's lattice in world units."""
        return surface.lattice.spacing * self.scene.subject.length_scale


class Work(Protocol):
    """What a stage does in steps."""

    def step(self, iteration: int) -> Mapping[str, float]:
        """One step; returns what is logged."""

    def preview(self) -> Preview:
        """The surface as it is."""


class Steps(Protocol):
    """What a stage may ask of whoever runs it."""

    done: int
    """Steps that a run before has done; 0 of a stage that begins."""
    kept: Mapping[str, np.ndarray]
    """What ``state`` gave then; empty of a stage that begins."""

    def run(self, work: Work, count: int, optimizers: Mapping[str, mi.ad.Adam],
            state: Callable[[], dict[str, np.ndarray]] = dict,
            stalled: Callable[[int], bool] = lambda done: False, surface: Surface | None = None) -> None:
        """Does the steps that are left, once per stage. Each is logged, and now and then all is saved.

        Args:
            work: does them.
            count: of steps.
            optimizers: by name; they are saved, and restored where a stage goes on.
            state: what else to keep for a run that goes on.
            stalled: whether the stage ends after so many steps, though some are left.
            surface: that a stage which goes on is given, if another one than this stage was given.
        """

    def repeat(self, work: Work, count: int, first: int) -> None:
        """Does all steps once more, logged as those from ``first`` on; a run that goes on does them again."""

    def task(self, name: str = "", total: int | None = None) -> AbstractContextManager[Callable[[], None]]:
        """What is done inside has a line of its own, and counts as time of the stage.

        Args:
            name: what to call it, after the stage's name.
            total: how often the function is called that the context gives.
        """

    def fact(self, name: str, value: Any) -> None:
        """Something for the metrics; of a JSON type."""


class Stage(Protocol):
    """One stage of a fit."""

    name: str
    """What log, progress, metrics and settings call it."""

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """Makes a better surface of a surface."""
