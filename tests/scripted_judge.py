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

    def parts(self, template: Mesh) -> "ScriptedParts":
        """Of the template."""
        return ScriptedParts(template[1], self)

    def compare_parts(self, before: np.ndarray, after: np.ndarray, label: np.ndarray) -> Verdict:
        """By the mean errors of each place's vertices."""
        told = label >= 0
        number = np.maximum(np.bincount(label[told]), 1)
        first, second = (np.bincount(label[told], self.error(opaque)[told]) / number
                         for opaque in (before, after))
        gain = np.log(np.maximum(first, 1e-9) / np.maximum(second, 1e-9))
        return Verdict(first, second, gain, np.full(len(gain), self.noise))


class ScriptedParts:
    """Parts of a template are (V,) which of its vertices are opaque."""

    def __init__(self, faces: np.ndarray, judge: ScriptedJudge):
        self.faces, self._judge = faces, judge
        self.all = self.of(np.ones(judge.count))

    def of(self, values: np.ndarray) -> np.ndarray:
        """What is positive."""
        self._judge.asked.append(values > 0)
        return values > 0
