"""``--preview`` changes defaults, and only those."""

import json
from types import SimpleNamespace

import pytest
from bowl import CLOSED, SHORT

from gshell_mi.fit import FitConfig, run
from gshell_mi.fit.__main__ import main


@pytest.fixture
def given(monkeypatch, tmp_path):
    """What the command hands to the fit."""
    calls = []

    def fit_scene(scene, output, **others):
        calls.append(SimpleNamespace(scene=scene, output=output, **others))
        counts = {"vertices": 0, "faces": 0, "boundary_loops": 0, "components": 0}
        metrics = {"counts": counts, "psnr_training": 0.0, "seconds": {"total": 0.0}}
        return run.FitResult(tmp_path, metrics)

    monkeypatch.setattr(run, "fit_scene", fit_scene)

    def call(*arguments):
        assert main(["scene.xml", *arguments]) == 0
        return calls.pop()

    return call


def test_preview_is_less_work_in_every_respect(given):
    usual, rough = given(), given("--preview")
    assert usual.config == FitConfig() and usual.report
    assert rough.config == FitConfig.preview() and not rough.report
    assert rough.config.resolution < 64
    for name in ("ghost_batch", "carving_iterations", "refinement_iterations", "iterations", "primal_spp",
                 "max_depth", "light_height", "triptychs"):
        assert getattr(rough.config, name) < getattr(usual.config, name), name
    pixels = [config.ghost_iterations * config.ghost_batch for config in (rough.config, usual.config)]
    assert pixels[0] < pixels[1] / 2
    assert rough.config.ghost_iterations >= usual.config.ghost_iterations, "openings need their time"


@pytest.mark.parametrize("order", [1, -1])
def test_other_options_override_those_of_the_preview(given, order):
    words = [["--preview"], ["--iterations", "70"], ["--resolution", "24"], ["--watertight"], ["-o", "there"]]
    found = given(*(word for group in words[::order] for word in group))
    assert found.config == FitConfig.preview(iterations=70, resolution=24, watertight=True)
    assert str(found.output) == "there" and str(found.scene) == "scene.xml"


def test_a_value_equal_to_the_usual_default_counts_too(given):
    usual = FitConfig().primal_spp
    assert FitConfig.preview().primal_spp != usual
    assert given("--preview", "--primal-spp", str(usual)).config.primal_spp == usual


def test_without_refinement_there_is_no_ghost_for_it(bowl_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "RefinementRounds", None)
    short = [*SHORT, *CLOSED, "--iterations", "1", "--refinement-iterations", "0"]
    assert main([str(bowl_scene), "-o", str(tmp_path), *short]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["refinement_kept"] is False and metrics["counts"]["faces"] > 0


def test_mistakes_are_told_as_without(capfd):
    assert main(["scene.xml", "--preview", "--spp", "0"]) == 2
    assert "--spp must be at least 1, not 0" in capfd.readouterr().err


def test_scene_is_still_needed(capfd):
    with pytest.raises(SystemExit) as stop:
        main(["--preview"])
    assert stop.value.code == 2 and "scene" in capfd.readouterr().err.lower()
