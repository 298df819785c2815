"""``--effort preview`` changes defaults, and only those."""

import json
from types import SimpleNamespace

import pytest
from bowl import CLOSED, SHORT

from gshell_mi.fit import FitConfig, api
from gshell_mi.fit.__main__ import main


@pytest.fixture
def given(monkeypatch, tmp_path):
    """What the command hands to the fit."""
    calls = []

    def fit_scene(scene, output, **others):
        calls.append(SimpleNamespace(scene=scene, output=output, **others))
        counts = {"vertices": 0, "faces": 0, "boundary_loops": 0, "components": 0}
        metrics = {"counts": counts, "psnr_training": 0.0, "seconds": {"total": 0.0}}
        return api.FitResult(tmp_path, metrics)

    monkeypatch.setattr(api, "fit_scene", fit_scene)

    def call(*arguments):
        assert main(["scene.xml", *arguments]) == 0
        return calls.pop()

    return call


def test_preview_is_less_work_in_every_respect(given):
    usual, rough = given(), given("--effort", "preview")
    assert usual.config == FitConfig() and usual.report
    assert rough.config == FitConfig.for_effort("preview") and not rough.report
    assert rough.config.resolution < 64
    before, after = usual.config.settings(), rough.config.settings()
    for name in (
        "radiance.batch",
        "cavities.iterations",
        "refinement.iterations",
        "iterations",
        "render.primal_spp",
        "render.max_depth",
        "model.light_height",
        "triptychs",
    ):
        assert after[name] < before[name], name
    pixels = [settings["openings.iterations"] * settings["radiance.batch"] for settings in (after, before)]
    assert pixels[0] < pixels[1] / 2
    assert after["openings.iterations"] >= before["openings.iterations"], "openings need their time"


def test_thorough_is_twice_as_many_steps_of_every_stage_and_a_finer_end(given):
    usual, more = given().config.settings(), given("--effort=thorough").config.settings()
    changed = {name for name in usual if more[name] != usual[name]}
    assert changed == {name for name in usual if name.endswith("iterations")} | {"volume.detail_resolution"}
    assert len(changed) == 8
    assert all(more[name] == 2 * usual[name] for name in changed)


def test_an_effort_that_there_is_not(capfd):
    assert main(["scene.xml", "--effort", "heroic"]) == 2
    assert "heroic" in capfd.readouterr().err


@pytest.mark.parametrize("order", [1, -1])
def test_other_options_override_those_of_the_preview(given, order):
    words = [
        ["--effort", "preview"],
        ["--iterations", "70"],
        ["--resolution", "24"],
        ["--watertight"],
        ["-o", "there"],
    ]
    found = given(*(word for group in words[::order] for word in group))
    assert found.config == FitConfig.for_effort("preview", iterations=70, resolution=24, watertight=True)
    assert str(found.output) == "there" and str(found.scene) == "scene.xml"


def test_a_value_equal_to_the_usual_default_counts_too(given):
    usual = FitConfig().render.primal_spp
    assert FitConfig.for_effort("preview").render.primal_spp != usual
    assert given("--effort", "preview", "--render.primal-spp", str(usual)).config.render.primal_spp == usual


def test_without_refinement_there_is_no_radiance_for_it(bowl_scene, tmp_path, monkeypatch):
    monkeypatch.setattr("gshell_mi.fit.stages.refinement.SurfaceRadiance", None)
    short = [*SHORT, *CLOSED, "--iterations", "1", "--refinement.iterations", "0"]
    assert main([str(bowl_scene), "-o", str(tmp_path), *short]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["refinement_kept"] is False and metrics["counts"]["faces"] > 0


def test_mistakes_are_told_as_without(capfd):
    assert main(["scene.xml", "--effort", "preview", "--render.spp", "0"]) == 2
    assert "--render.spp must be at least 1, not 0" in capfd.readouterr().err


def test_scene_is_still_needed(capfd):
    assert main(["--effort", "preview"]) == 2
    assert "scene" in capfd.readouterr().err.lower()
