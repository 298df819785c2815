"""Watching a fit while it runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...scene import FitScene


@dataclass(frozen=True)
class Preview:
    """What a fit has found until now.

    Attributes:
        vertices: (V, 3) world positions.
        faces: (F, 3) of the open mesh.
        colors: (V, 3) linear Rec.709: radiance of the front before the joint stage, base colour in it.
        template_vertices, template_faces: the watertight template.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    template_vertices: np.ndarray
    template_faces: np.ndarray


class Observer(Protocol):
    """What ``fit_scene`` tells of its progress; called on its thread, so it waits for the observer."""

    def begin(self, given: FitScene) -> None:
        """Before the first stage."""

    def step(
        self, stage: str, iteration: int, count: int, values: dict[str, float], preview: Callable[[], Preview]
    ) -> None:
        """After each of the ``count`` steps of a stage.

        Args:
            values: the losses and ``psnr`` of the step.
            preview: takes what is there out of the optimisers, some milliseconds; call it rarely.
        """
