"""What each stage of a fit makes of the surface that it is given."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from gshell_mi.evaluation.mesh_scores import mesh_scores, read_mesh
from gshell_mi.preview import Preview
from gshell_mi.scene import FitScene


class StageScores:
    """An observer of a fit that scores the surface after each of its stages.

    Args:
        truth: mesh file to score against.

    Attributes:
        scores: of the mesh, as ``mesh_scores`` gives them, by stage; empty where there is none yet.
        cpu_seconds: that it has taken itself, on all threads.
    """

    def __init__(self, truth: Path):
        self._truth, self._last = read_mesh(truth), np.zeros((0, 3))
        self.scores: dict[str, dict] = {}
        self.cpu_seconds = 0.0

    def begin(self, given: FitScene) -> None:
        """Nothing is there yet."""

    def step(
        self, stage: str, iteration: int, count: int, values: dict[str, float], preview: Callable[[], Preview]
    ) -> None:
        """Only whole stages are scored."""

    def stage_done(self, stage: str, preview: Callable[[], Preview]) -> None:
        """Scores what a stage has left."""
        begin = time.process_time()
        shown = preview()
        if not len(shown.faces):
            self.scores[stage] = {}
        elif np.array_equal(shown.vertices, self._last):
            self.scores[stage] = list(self.scores.values())[-1]
        else:
            mesh = trimesh.Trimesh(shown.vertices, shown.faces, process=False)
            self.scores[stage] = mesh_scores(mesh, self._truth)
        self._last = shown.vertices
        self.cpu_seconds += time.process_time() - begin

    def with_seconds(self, seconds: dict[str, float]) -> dict[str, dict]:
        """By stage, in their order: its ``seconds``, of those of all, and its ``mesh`` scores."""
        return {
            stage: {"seconds": seconds.get(stage, 0.0), "mesh": scores}
            for stage, scores in self.scores.items()
        }
