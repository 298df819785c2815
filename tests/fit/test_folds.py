"""The second round of the refinement: kept where unseen views gain by it, dropped where not."""

import json
from dataclasses import replace

import pytest
from bowl import CLOSED, SHORT

from gshell_mi.fit import FitConfig
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.refinement import PhotometricRefinement

TWO_ROUNDS = (*SHORT, *CLOSED, "--folds-iterations", "4", "--iterations", "0")


def run(scene, output, *arguments):
    assert main([str(scene), "-o", str(output), "--quiet", *TWO_ROUNDS, *arguments]) == 0
    return json.loads((output / "metrics.json").read_text())


def steps(output):
    lines = map(json.loads, (output / "log.jsonl").read_text().splitlines())
    return [(step["stage"], step["iteration"]) for step in lines if step["stage"] in ("refinement", "folds")]


def rounds(first, second):
    return [("refinement", i) for i in range(first)] + [("folds", i) for i in range(second)]


def test_it_goes_on_where_the_first_round_has_ended():
    before = FitConfig(refinement_detail=20.0, folds_iterations=7, folds_lr=0.4, folds_detail=5.0)
    after = before.for_folds()
    assert (after.refinement_iterations, after.refinement_lr) == (7, 0.4)
    assert (after.refinement_smoothing, after.refinement_detail) == (20, 5)
    assert replace(after, refinement_iterations=before.refinement_iterations, refinement_detail=20.0,
                   refinement_lr=before.refinement_lr,
                   refinement_smoothing=before.refinement_smoothing) == before


@pytest.mark.parametrize(("gain", "kept"), [("0", False), ("1000", True)])
def test_metrics_say_whether_it_was_kept(bowl_scene, tmp_path, gain, kept):
    metrics = run(bowl_scene, tmp_path, "--refinement-gain", "1000", "--folds-gain", gain)
    assert (metrics["refinement_kept"], metrics["folds_kept"]) == (True, kept)
    assert steps(tmp_path) == rounds(2, 4) and metrics["seconds"]["folds"] > 0


@pytest.mark.parametrize("arguments", [("--refinement-gain", "0"),
                                       ("--refinement-gain", "1000", "--folds-iterations", "0")],
                         ids=["first round dropped", "off"])
def test_there_may_be_none(bowl_scene, tmp_path, arguments):
    assert "folds_kept" not in run(bowl_scene, tmp_path, *arguments)
    assert steps(tmp_path) == rounds(2, 0)


def test_ended_within_it_and_resumed(bowl_scene, tmp_path, monkeypatch):
    step = PhotometricRefinement.step

    def ends(self, iteration):
        if self.config.refinement_iterations == 4 and iteration == 2:
            raise MemoryError
        return step(self, iteration)

    arguments = ("--refinement-gain", "1000", "--folds-gain", "1000", "--checkpoint-seconds", "0")
    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(PhotometricRefinement, "step", ends)
        run(bowl_scene, tmp_path, *arguments)
    assert not (tmp_path / "mesh.ply").exists()
    metrics = run(bowl_scene, tmp_path, *arguments, "--resume")
    assert steps(tmp_path) == rounds(2, 4) and metrics["folds_kept"]
