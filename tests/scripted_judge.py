"""A judge whose evidence is given: an error per vertex for what is opaque."""

from collections.abc import Callable

import numpy as np

from gshell_mi.fit.judge import Mesh, Verdict


class ScriptedJudge:
    """Takes the place of ``Judge`` where a test says how badly images are explained.

    Args:
        count: vertices of the template.
        error: maps (V,) opaque or not to (V,) errors of the rays that meet each vertex first.
        noise: standard error of every gain.
    """

    def __init__(self, count: int, error: Callable[[np.ndarray], np.ndarray], noise: float = 0.05):
        self.count, self.error, self.noise = count, error, noise
        self.asked: list[np.ndarray] = []

    def shown(self, mesh: Mesh, like: object = None) -> "ScriptedTemplate":
        """The template."""
        return ScriptedTemplate(mesh, self)

    def compare(
        self, before: np.ndarray, after: np.ndarray, label: np.ndarray, where: object = None, places: int = 1
    ) -> Verdict:
        """By the mean errors of each place's vertices; nothing is told of a place without any."""
        told = label >= 0
        count = np.bincount(label[told], minlength=places)
        first, second = (
            np.bincount(label[told], self.error(opaque)[told], places) / np.maximum(count, 1)
            for opaque in (before, after)
        )
        gain = np.log(np.maximum(first, 1e-9) / np.maximum(second, 1e-9))
        return Verdict(first, second, gain, np.where(count > 0, self.noise, np.inf))


class ScriptedTemplate:
    """A part of it is (V,) which of its vertices are opaque."""

    def __init__(self, mesh: Mesh, judge: ScriptedJudge):
        self.mesh, self._judge = mesh, judge
        self.whole = self.part(np.ones(judge.count))

    def part(self, values: np.ndarray) -> np.ndarray:
        """What is positive."""
        self._judge.asked.append(values > 0)
        return values > 0
