"""Watching a fit while it runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from ...preview import Preview
from ...scene import FitScene


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

    def stage_done(self, stage: str, preview: Callable[[], Preview]) -> None:
        """After each stage; ``preview`` makes what it has left, in one colour."""
