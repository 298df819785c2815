"""A light that turns with the camera, as where an object turns on a turntable."""

import dataclasses
import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from bowl import CLOSED, RADIUS, SHORT, half_sphere, write_scene
from silent_steps import Silent

from gshell_mi.fit import FitConfig
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.judge import Judge
from gshell_mi.fit.stage import Fit
from gshell_mi.fit.stages.light_frame import LightFrame
from gshell_mi.fit.surface import Surface
from gshell_mi.light import EnvironmentLight, turns_with_camera
from gshell_mi.scene import load_fit_scene
from gshell_mi.scene_files import load_scene


def _camera(angle: float) -> mi.Sensor:
    x, z = 3 * np.sin(angle), 3 * np.cos(angle)
    return mi.load_dict(
        {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([x, 0.0, z], [0, 0, 0], [0, 1, 0])}
    )


def test_the_light_turns_as_the_camera_does():
    turns = turns_with_camera([_camera(0.0), _camera(np.pi / 2)])
    assert np.allclose(turns[0], np.eye(3), atol=1e-6)
    # What the first camera has behind it, the second has behind it, too.
    assert np.allclose(turns[1] @ [0, 0, 1], [1, 0, 0], atol=1e-6)


def test_a_rotation_of_the_map_comes_first():
    turn, own = mi.ScalarTransform4f().rotate([0, 1, 0], 30), mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    light = EnvironmentLight(np.ones((4, 8, 3), np.float32), own)
    found = np.array(light.turned(np.array(turn.matrix)[:3, :3]).matrix).reshape(4, 4)
    assert np.allclose(found, np.array((turn @ own).matrix), atol=1e-6)


@pytest.fixture(scope="module")
def turntable(bowl_scene, tmp_path_factory) -> Path:
    """Targets that are rendered under a light from the camera's left; in the world no light is like that."""
    folder = tmp_path_factory.mktemp("turntable")
    bare = write_scene(folder)
    truth, scene = load_scene(bare.with_suffix("") / "reference.xml"), load_fit_scene(bowl_scene)
    side = np.full((8, 16, 3), 0.02, np.float32)
    side[3:5, 2:6] = 8.0
    light = EnvironmentLight(side)
    shapes = {f"shape_{index}": shape for index, shape in enumerate(truth.shapes())}
    lit = mi.load_dict({"type": "scene", "light": light.emitter(), **shapes})
    parameters, targets = mi.traverse(lit), folder / "targets"
    targets.mkdir()
    integrator = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    for sensor, turn in zip(scene.sensors, turns_with_camera(scene.sensors), strict=True):
        parameters["light.to_world"] = light.turned(turn)
        parameters.update()
        image = mi.render(lit, sensor=sensor, integrator=integrator, spp=64)
        mi.Bitmap(image, mi.Bitmap.PixelFormat.RGBA).write(str(targets / f"{sensor.id()}.exr"))
    return targets


@pytest.fixture(scope="module")
def turning(bowl_scene, turntable) -> Fit:
    return Fit.of(load_fit_scene(bowl_scene, turntable), FitConfig())


def ball(fit: Fit) -> Surface:
    """What the bowl's hull is like."""
    fields, scale = fit.scene.subject.fields(), fit.scene.subject.length_scale
    distance = np.linalg.norm(fields.lattice.vertex_positions(), axis=1) - RADIUS / scale
    return Surface(fields).with_fields(sdf=distance.astype(np.float32), msdf=np.ones_like(fields.msdf))


def test_a_light_that_turns_is_found(turning):
    surface = LightFrame(turning.config.gains).run(turning, ball(turning), Silent())
    assert turning.corrected(surface).light_turns and not turning.light_turns


def test_a_light_that_stays_is_left_alone(exact):
    surface = LightFrame(exact.config.gains).run(exact, ball(exact), Silent())
    assert not exact.corrected(surface).light_turns


def test_what_is_found_outlives_a_checkpoint(turning):
    surface = dataclasses.replace(ball(turning), light_turns=np.array(True))
    assert turning.corrected(Surface.from_arrays(surface.to_arrays())).light_turns


def test_the_judge_takes_a_turning_light_into_account(turning):
    """One factor over the mirrored direction explains shading only in the frame that the light is in."""
    mesh = half_sphere(64)
    errors = {}
    for turns in (False, True):
        views = dataclasses.replace(turning, light_turns=turns).views
        judge = Judge(views, turning.scene.targets, Judge.halves(len(views)), batch=8192)
        errors[turns] = judge.decide((mesh.vertices, mesh.faces), (mesh.vertices, mesh.faces)).before[0]
    assert errors[True] < 0.8 * errors[False]


@pytest.mark.slow
def test_each_view_of_a_turntable_is_explained_by_one_light(bowl_scene, turntable, tmp_path):
    scores = {}
    for frame in ("world", "camera"):
        settings = [*SHORT, *CLOSED, "--iterations", "60", "--light-frame", frame]
        out = tmp_path / frame
        main([str(bowl_scene), "-o", str(out), "--targets", str(turntable), *settings])
        scores[frame] = json.loads((out / "metrics.json").read_text())["psnr_training"]
    assert scores["camera"] > scores["world"] + 1
