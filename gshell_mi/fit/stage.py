"""What a stage of the fit is: something that makes a better surface of a surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ..calibration.corrections import Corrections
from ..fields.mask_distances import MaskDistances
from ..light import turns_with_camera
from ..packed_pixels import unpacked
from ..pixels import PixelPool
from ..preview import Preview
from ..scene import FitScene
from ..views import PinholeViews
from .judge import Judge
from .lattices import Lattices
from .surface import Surface

if TYPE_CHECKING:
    from .config import FitConfig
    from .runner import Steps

#: Every eighth view validates what the colours of the others have moved; what ``--hold-out`` keeps no stage
#: sees at all.
_VALIDATION = 8


@dataclass(frozen=True)
class Fit:
    """What all stages may read.

    Attributes:
        scene: with its targets. Path tracing sets the fields of its shape; no other stage reads them.
        config: the settings.
        lattices: that stages work on.
        light_turns: whether the light turns with the camera.
    """

    scene: FitScene
    config: FitConfig
    lattices: Lattices
    light_turns: bool = False

    @classmethod
    def of(cls, scene: FitScene, config: FitConfig) -> Fit:
        """Of what is given."""
        return cls(scene, config, Lattices.of(scene.subject, config), config.light_frame == "camera")

    @cached_property
    def views(self) -> PinholeViews:
        """The cameras."""
        views, sensors = PinholeViews.from_sensors(self.scene.sensors), self.scene.sensors
        return replace(views, turns=turns_with_camera(sensors)) if self.light_turns else views

    @cached_property
    def alphas(self) -> list[np.ndarray]:
        """Coverage of each view, (height, width), the largest that what is known allows."""
        return [target.most_alpha for target in self.scene.targets]

    @cached_property
    def masks(self) -> MaskDistances:
        """Distances to the outlines of ``alphas``."""
        return MaskDistances(self.views, self.alphas)

    @cached_property
    def pixels(self) -> PixelPool:
        """The pixels of all views."""
        return PixelPool(self.views, self.scene.targets)

    @cached_property
    def training(self) -> PixelPool:
        """The pixels of the views whose colours the refinement knows; the others validate it."""
        return PixelPool(self.views, self.scene.targets, self._validation[0])

    @cached_property
    def judge(self) -> Judge:
        """Decides on changes that were proposed by all views."""
        return self._judge(Judge.halves(len(self.views)))

    @cached_property
    def outline_judge(self) -> Judge:
        """Decides on changes of the surface that the joint stage leaves. It ends where masks do, to a pixel,
        so pixels beside outlines count: only they tell of a strip along a rim, as of leaf and lace."""
        return self._judge(self.judge.splits, off_outline=0, like=self.judge)

    @cached_property
    def validation_judge(self) -> Judge:
        """Tells what the other views say of what was fitted to ``training``."""
        return self._judge([self._validation])

    def _judge(self, splits: list[tuple[np.ndarray, np.ndarray]], **options: Any) -> Judge:
        batch, seed = self.config.radiance.batch, self.config.seed
        return Judge(self.views, self.scene.targets, splits, batch=batch, seed=seed, **options)

    @property
    def _validation(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the views of ``training``, and of the others."""
        every = np.arange(len(self.views))
        validation = every[::_VALIDATION]
        return np.setdiff1d(every, validation) if len(every) > 1 else every, validation

    def corrected(self, surface: Surface) -> Fit:
        """The same with what was found of the views: targets as if all were exposed alike, without what is
        ignored, cameras where they are, and what the light is fixed to.

        The pools of this one are let go, and made again if they are asked for: two of each would be as large
        as the targets many times over.

        Args:
            surface: that tells; of a fit as it was given.
        """
        for pool in ("masks", "pixels", "training", "judge", "outline_judge", "validation_judge"):
            self.__dict__.pop(pool, None)
        targets, sensors = self.scene.targets, self.scene.sensors
        if surface.gains is not None:
            targets = [target.divided(gain) for target, gain in zip(targets, surface.gains, strict=True)]
        if surface.ignored is not None:
            targets = [
                target.ignoring(pixels)
                for target, pixels in zip(targets, unpacked(surface.ignored, self.views.sizes), strict=True)
            ]
        if surface.poses is not None:
            sensors = Corrections.from_array(surface.poses).sensors(sensors)
        turns = self.light_turns if surface.light_turns is None else bool(surface.light_turns)
        return replace(self, scene=replace(self.scene, sensors=sensors, targets=targets), light_turns=turns)

    def mesh(self, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
        """A surface's vertices (V, 3), in world units, and faces (F, 3)."""
        vertices, faces, _ = self.scene.subject.surface_of(surface.fields).to_numpy()
        return vertices, faces

    def cell(self, surface: Surface) -> float:
        """Side of a cell of a surface's lattice in world units."""
        return surface.lattice.spacing * self.scene.subject.length_scale


class Work(Protocol):
    """What a stage does in steps."""

    def step(self, iteration: int) -> Mapping[str, float]:
        """One step; returns what is logged."""
        ...

    def preview(self) -> Preview:
        """The surface as it is."""
        ...


class Stage(Protocol):
    """One stage of a fit."""

    name: str
    """What log, progress, metrics and settings call it."""

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """Makes a better surface of a surface."""
        ...
