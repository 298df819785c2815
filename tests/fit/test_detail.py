"""The detail stage: the joint stage continued on a finer lattice."""

import json
from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from bowl import CLOSED, RADIUS, SHORT
from silent_steps import Silent

from gshell_mi.fields import LatticeFields, sphere
from gshell_mi.fit import FitConfig
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.joint.joint import JointStage
from gshell_mi.fit.lattices import Lattices
from gshell_mi.fit.pipeline import pipeline
from gshell_mi.fit.stage import Fit
from gshell_mi.fit.stages.joint import (
    DetailConfig,
    Joint,
    JointConfig,
    start_fields,
    start_light,
    start_material,
)
from gshell_mi.fit.surface import Seen, Surface
from gshell_mi.lattice import FlexiCubesLattice
from gshell_mi.light import EnvironmentLight
from gshell_mi.material import MaterialField
from gshell_mi.scene import load_fit_scene

CONFIG = FitConfig().changed(
    {
        "lattice.band_resolution": 32,
        "render.spp": 1,
        "render.primal_spp": 1,
        "render.max_depth": 2,
        "model.light_height": 4,
    }
)


@pytest.mark.parametrize("resolution", [30, 40], ids=["whole lattice", "blocks"])
def test_it_starts_with_what_the_joint_stage_has_left(bowl_scene, resolution):
    fit, lattice = load_fit_scene(bowl_scene), FlexiCubesLattice(20)
    points = lattice.vertex_positions()
    deform = np.sin(3 * points[:, [1, 2, 0]])
    moved = points + lattice.max_offset * deform
    fields = LatticeFields(
        (np.linalg.norm(moved, axis=1) - RADIUS).astype(np.float32),
        (0.1 - moved[:, 1]).astype(np.float32),
        deform.astype(np.float32).ravel(),
        "flexicubes",
    )
    fit.subject.set_fields(fields)
    light = EnvironmentLight.uniform(4, 1.0)
    light.log_radiance = mi.TensorXf(np.random.default_rng(0).normal(size=(4, 8, 3)).astype(np.float32))
    material = MaterialField(0.5 + 0.2 * points, roughness=0.3, metallic=0.7)
    joint = JointStage(fit, material, light, CONFIG)
    joint.finish()
    seen = Seen(np.zeros((len(points), 3)), np.zeros(len(points), bool), np.float32(1))
    left = Surface(joint.moved_fields(), seen=seen, model=joint.model())

    finer = FlexiCubesLattice(resolution)
    start = start_fields(fit.subject, left, finer, CONFIG.lattice.band_resolution, {})
    assert (start.blocks is None) == (resolution < CONFIG.lattice.band_resolution)
    fit.subject.set_fields(start)
    vertices = fit.subject.surface.to_numpy()[0]
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).mean() < 0.05 * lattice.spacing
    assert vertices[:, 1].max() == pytest.approx(0.1, abs=0.1 * lattice.spacing)
    values = start_material(fit, left, start.lattice, CONFIG).values()
    np.testing.assert_allclose(values["vertex_roughness"].numpy(), 0.3, atol=1e-3)
    np.testing.assert_allclose(values["vertex_metallic"].numpy(), 0.7, atol=1e-3)
    color = values["vertex_color"].numpy().reshape(-1, 3)
    inside = start.lattice.points(mi.Float).numpy().T
    inside = np.abs(inside).max(axis=1) <= 1
    expected = 0.5 + 0.2 * start.lattice.points(mi.Float).numpy().T
    np.testing.assert_allclose(color[inside], expected[inside], atol=5e-3)
    np.testing.assert_array_equal(
        start_light(fit, left, CONFIG).log_radiance.numpy(), light.log_radiance.numpy()
    )


def test_its_steps_are_not_those_of_the_joint_stage_again(bowl_scene):
    config = CONFIG.changed({"iterations": 5, "detail.iterations": 4})
    scene = load_fit_scene(bowl_scene)
    joint, detail = (
        stage
        for stage in pipeline(scene, Lattices.of(scene.subject, config), config)
        if stage.name in ("joint", "detail")
    )
    assert (joint.before, detail.before) == (0, 5)
    first, second = (SimpleNamespace(_before=stage.before, config=config) for stage in (joint, detail))
    assert JointStage.seed(second, 0) == JointStage.seed(first, 5)


def test_its_rates_are_those_of_what_has_settled():
    before, after = JointConfig(), DetailConfig()
    assert (after.warmup, after.color_hold) == (0, 0)
    assert after.geometry_lr < before.geometry_lr and after.geometry_smoothing < before.geometry_smoothing
    assert after.material_lr < before.material_lr and after.light_lr < before.light_lr


@pytest.mark.parametrize(
    ("arguments", "stages"),
    [
        (("--iterations", "2", "--detail.iterations", "3"), {"joint": 2, "detail": 3}),
        (("--iterations", "2", "--detail.iterations", "0"), {"joint": 2}),
        (("--iterations", "0"), {}),
        (("--iterations", "2", "--model.field", "multiresolution"), {"joint": 2}),
        (("--iterations", "2", "--lattice.start-resolution", "24"), {"joint": 2}),
    ],
)
def test_when_there_is_one(bowl_scene, tmp_path, arguments, stages):
    command = [
        str(bowl_scene),
        "-o",
        str(tmp_path),
        "--quiet",
        *SHORT,
        *CLOSED,
        "--lattice.start-resolution",
        "16",
        "--resolution",
        "24",
        *arguments,
    ]
    assert main(command) == 0
    log = [json.loads(line)["stage"] for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert {stage: log.count(stage) for stage in ("joint", "detail") if stage in log} == stages
    seconds = json.loads((tmp_path / "metrics.json").read_text())["seconds"]
    assert ("detail" in seconds) == ("detail" in stages)


def test_it_goes_over_a_surface_in_blocks_again(bowl_scene):
    """One as fine already, which has changed since material and light were fitted to it."""
    fit, surface = _ball_in_blocks(bowl_scene, {"resolution": 40})
    stage = Joint("detail", fit.config.detail, 1)
    found = stage.run(fit, surface, Silent())
    assert found.settled and found.lattice.resolution == 40
    assert stage.run(fit, found, Silent()) is found
    again = stage.run(fit, replace(found, settled=False), Silent())
    assert again.settled and again.lattice.resolution == 40
    colors = (surface.model["vertex_color"].reshape(-1, 3).mean(axis=0) for surface in (found, again))
    np.testing.assert_allclose(*colors, atol=0.1, err_msg="the material goes on")


def test_a_surface_in_blocks_goes_on_in_finer_ones(bowl_scene):
    """As one of a radiance volume does."""
    settings = {"resolution": None, "lattice.start_resolution": 16, "volume.resolution": 40}
    fit, surface = _ball_in_blocks(bowl_scene, settings | {"volume.detail_resolution": 80})
    stage = Joint("detail", fit.config.detail, 1)
    found = Joint("joint", fit.config.joint, 1, fit.lattices.late).run(fit, surface, Silent())
    assert found.settled and found.lattice.resolution == 40
    fine = stage.run(fit, found, Silent())
    assert fine.settled and fine.lattice.resolution == 80 and stage.run(fit, fine, Silent()) is fine
    radius = [
        np.linalg.norm(fit.scene.subject.surface_of(each.fields).to_numpy()[0], axis=1)
        for each in (found, fine)
    ]
    assert len(radius[1]) > 3.5 * len(radius[0])
    cell = fit.cell(found)
    assert np.abs(radius[1] - np.median(radius[0])).max() < 0.5 * cell
    colors = (each.model["vertex_color"].reshape(-1, 3).mean(axis=0) for each in (found, fine))
    np.testing.assert_allclose(*colors, atol=0.1, err_msg="the material goes on")


def _ball_in_blocks(bowl_scene, settings):
    config = CONFIG.changed({"detail.iterations": 1, "lattice.band_resolution": 40} | settings)
    scene, lattice = load_fit_scene(bowl_scene), FlexiCubesLattice(40)
    count = lattice.vertex_count
    seen = Seen(np.full((count, 3), 0.5), np.full(count, True), np.float32(1))
    surface = Surface(sphere(lattice, RADIUS).in_blocks(), seen=seen)
    return Fit.of(scene, config), surface
