"""Rounds that get nowhere end early: a loss that has not fallen after a quarter of the steps will not."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...preview import Preview
from ..stage import Work


class EarlyStopping:
    """A worker whose image loss at the first steps is compared with that at a quarter of them.

    Each step looks at pixels of its own, so an eighth of the steps up to there are averaged at either end.

    Args:
        worker: does the steps, and logs ``image``.
        count: of its steps.
        descent: the fraction of the first loss that the later one must stay below.
        state: has the ``descent`` so far, (2,) sums of losses at first and later, where the worker goes on.
    """

    def __init__(self, worker: Work, count: int, descent: float, state: Mapping[str, np.ndarray]):
        self.worker, self.descent = worker, descent
        self._judged = -(-count // 4)
        self._width = -(-self._judged // 8)
        self._sums = np.array(state.get("descent", np.zeros(2)))

    def step(self, iteration: int) -> Mapping[str, float]:
        """One step of the worker."""
        values = self.worker.step(iteration)
        if iteration < self._width:
            self._sums[0] += values["image"]
        if self._judged - self._width <= iteration < self._judged:
            self._sums[1] += values["image"]
        return values

    def preview(self) -> Preview:
        """The worker's."""
        return self.worker.preview()

    def state(self) -> dict[str, np.ndarray]:
        """What a checkpoint keeps, so that a fit that goes on decides alike."""
        return {"descent": self._sums.copy()}

    def stalled(self, done: int) -> bool:
        """Whether the steps are not worth going on with after ``done`` of them."""
        return done >= self._judged and bool(self._sums[1] >= self.descent * self._sums[0])
