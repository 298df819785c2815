"""A light that turns with the camera, as where an object turns on a turntable."""

import json

import mitsuba as mi
import numpy as np
import pytest
from bowl import CLOSED, SHORT, write_scene

from gshell_mi.fit.__main__ import main
from gshell_mi.light import EnvironmentLight, turns_with_camera


def _camera(angle: float) -> mi.Sensor:
    x, z = 3 * np.sin(angle), 3 * np.cos(angle)
    return mi.load_dict(
        {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([x, 0.0, z], [0, 0, 0], [0, 1, 0])}
    )


def test_the_light_turns_as_the_camera_does():
    turns = turns_with_camera([_camera(0.0), _camera(np.pi / 2)])
    assert np.allclose(np.array(turns[0].matrix), np.eye(4), atol=1e-6)
    # What the first camera has behind it, the second has behind it, too.
    assert np.allclose(np.array(turns[1] @ mi.ScalarVector3f(0, 0, 1)), [1, 0, 0], atol=1e-6)


def test_a_rotation_of_the_map_comes_first():
    turn, own = mi.ScalarTransform4f().rotate([0, 1, 0], 30), mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    light = EnvironmentLight(np.ones((4, 8, 3), np.float32), own)
    found = np.array(light.turned(turn).matrix).reshape(4, 4)
    assert np.allclose(found, np.array((turn @ own).matrix), atol=1e-6)


@pytest.mark.slow
def test_each_view_of_a_turntable_is_explained_by_one_light(bowl_scene, tmp_path):
    """The targets are rendered under a light from the camera's left; in the world no light is like that."""
    from gshell_mi.scene import load_fit_scene
    from gshell_mi.scene_files import load_scene

    bare = write_scene(tmp_path)
    truth, scene = load_scene(bare.with_suffix("") / "reference.xml"), load_fit_scene(bowl_scene)
    side = np.full((8, 16, 3), 0.02, np.float32)
    side[3:5, 2:6] = 8.0
    lit = mi.load_dict(
        {
            "type": "scene",
            "light": EnvironmentLight(side).emitter(),
            **{f"shape_{index}": shape for index, shape in enumerate(truth.shapes())},
        }
    )
    parameters, folder = mi.traverse(lit), tmp_path / "targets"
    folder.mkdir()
    integrator = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    for sensor, turn in zip(scene.sensors, turns_with_camera(scene.sensors), strict=True):
        parameters["light.to_world"] = mi.Transform4f(turn)
        parameters.update()
        image = mi.render(lit, sensor=sensor, integrator=integrator, spp=64)
        mi.Bitmap(image, mi.Bitmap.PixelFormat.RGBA).write(str(folder / f"{sensor.id()}.exr"))
    scores = {}
    for frame in ("world", "camera"):
        out = tmp_path / frame
        main(
            [
                str(bowl_scene),
                "-o",
                str(out),
                "--targets",
                str(folder),
                *SHORT,
                *CLOSED,
                "--iterations",
                "60",
                "--light-frame",
                frame,
            ]
        )
        scores[frame] = json.loads((out / "metrics.json").read_text())["psnr_training"]
    assert scores["camera"] > scores["world"] + 1
