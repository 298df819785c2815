"""The second round of the refinement: kept where unseen views gain by it, dropped where not."""

import json

import numpy as np
import pytest
from bowl import CLOSED, SHORT

from gshell_mi.fit.__main__ import main
from gshell_mi.fit.refinement.early_stopping import EarlyStopping
from gshell_mi.fit.refinement.refinement import PhotometricRefinement
from gshell_mi.fit.stages.refinement import FoldsConfig, RefinementConfig

TWO_ROUNDS = (*SHORT, *CLOSED, "--folds.iterations", "4", "--folds.descent", "1000", "--iterations", "0")


def run(scene, output, *arguments):
    assert main([str(scene), "-o", str(output), "--quiet", *TWO_ROUNDS, *arguments]) == 0
    return json.loads((output / "metrics.json").read_text())


def steps(output):
    lines = map(json.loads, (output / "log.jsonl").read_text().splitlines())
    return [(step["stage"], step["iteration"]) for step in lines if step["stage"] in ("refinement", "folds")]


def rounds(first, second):
    return [("refinement", i) for i in range(first)] + [("folds", i) for i in range(second)]


def test_it_goes_on_where_the_first_round_has_ended():
    first, second = RefinementConfig(), FoldsConfig()
    assert second.smoothing == first.detail
    assert second.lr > first.lr and second.detail < first.detail


@pytest.mark.parametrize("kept", [False, True])
def test_metrics_say_whether_it_was_kept(bowl_scene, tmp_path, decisions, kept):
    decisions(True, kept)
    metrics = run(bowl_scene, tmp_path)
    assert (metrics["refinement_kept"], metrics["folds_kept"]) == (True, kept)
    assert steps(tmp_path) == rounds(2, 4) and metrics["seconds"]["folds"] > 0


@pytest.mark.parametrize(
    ("first", "arguments"),
    [(False, ()), (True, ("--folds.iterations", "0"))],
    ids=["first round dropped", "off"],
)
def test_there_may_be_none(bowl_scene, tmp_path, decisions, first, arguments):
    decisions(first)
    assert "folds_kept" not in run(bowl_scene, tmp_path, *arguments)
    assert steps(tmp_path) == rounds(2, 0)


def ended_within_it(scene, output, monkeypatch, *arguments):
    """Runs a fit that is ended before the third step of the second round."""
    step = PhotometricRefinement.step

    def ends(self, iteration):
        if isinstance(self.config, FoldsConfig) and iteration == 2:
            raise MemoryError
        return step(self, iteration)

    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(PhotometricRefinement, "step", ends)
        run(scene, output, *arguments)
    assert not (output / "mesh.ply").exists()


def test_ended_within_it_and_resumed(bowl_scene, tmp_path, monkeypatch, decisions):
    decisions(True, True)
    arguments = ("--checkpoint-seconds", "0")
    ended_within_it(bowl_scene, tmp_path, monkeypatch, *arguments)
    metrics = run(bowl_scene, tmp_path, *arguments, "--resume")
    assert steps(tmp_path) == rounds(2, 4) and metrics["folds_kept"]


STALLS = ("--folds.iterations", "16", "--folds.descent", "0")


def test_it_ends_after_a_quarter_where_the_error_does_not_fall(bowl_scene, tmp_path, decisions):
    decisions(True)
    metrics = run(bowl_scene, tmp_path, *STALLS)
    assert (metrics["refinement_kept"], metrics["folds_kept"]) == (True, False)
    assert steps(tmp_path) == rounds(2, 4) and metrics["seconds"]["folds"] > 0


def test_a_resumed_fit_ends_it_alike(bowl_scene, tmp_path, monkeypatch, decisions):
    decisions(True)
    arguments = (*STALLS, "--checkpoint-seconds", "0")
    ended_within_it(bowl_scene, tmp_path, monkeypatch, *arguments)
    metrics = run(bowl_scene, tmp_path, *arguments, "--resume")
    assert not metrics["folds_kept"] and steps(tmp_path) == rounds(2, 4)


class Losses:
    """Stands for the steps of a round."""

    def __init__(self, values):
        self.values = values

    def step(self, iteration):
        return {"image": self.values[iteration]}


@pytest.mark.parametrize(("later", "stalled"), [(0.98, False), (1.0, True), (1.2, True)])
def test_the_losses_before_a_quarter_decide(later, stalled):
    """Of 64 steps the first two, and those before the 16th."""
    losses = Losses(np.r_[1.1, 0.9, np.full(12, 7.0), later + 0.1, later - 0.1, np.full(48, 7.0)])
    whole = EarlyStopping(losses, 64, 0.99, {})
    for i in range(16):
        assert not whole.stalled(i)
        whole.step(i)
    assert whole.stalled(16) == stalled

    parts = EarlyStopping(losses, 64, 0.99, {})
    for i in range(16):
        parts = EarlyStopping(losses, 64, 0.99, parts.state())
        parts.step(i)
    assert parts.stalled(16) == parts.stalled(64) == stalled
