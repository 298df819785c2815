"""A NeRF-synthetic set made of one of our own scenes, imported: the targets are that scene's renderings."""

import importlib.util
import json
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from bowl import write_scene
from known_capture import known_cameras, write_nerf

from gshell_mi.capture import CaptureConfig, import_capture, read_capture
from gshell_mi.capture.writer import write_target
from gshell_mi.errors import UserError
from gshell_mi.scene import load_fit_scene


@pytest.fixture(scope="module")
def recipe():
    path = Path(__file__).parents[2] / "pipelines" / "make_nerf_capture.py"
    spec = importlib.util.spec_from_file_location("make_nerf_capture", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_photographed_scene_comes_back(recipe, tmp_path, monkeypatch, variant):
    """Through PNG, z-up, shrinking and y-up: as Mitsuba renders the true scene with the written sensors."""
    reference = write_scene(tmp_path).with_suffix("") / "reference.xml"
    monkeypatch.setattr(
        sys,
        "argv",
        [
            "make",
            str(reference),
            str(tmp_path / "set"),
            "--views",
            "6",
            "--test-views",
            "2",
            "--size",
            "96",
            "--spp",
            "32",
            "--variant",
            variant,
        ],
    )
    recipe.main()
    result = import_capture(tmp_path / "set", tmp_path / "imported.xml", config=CaptureConfig(max_size=32))
    assert (result.training, result.held_out) == (6, 2)
    assert len(json.loads((tmp_path / "set" / "transforms_train.json").read_text())["frames"]) == 6
    truth = mi.load_file(str(reference))
    scene = load_fit_scene(result.path)
    for sensor, target in zip(scene.sensors, scene.targets, strict=True):
        expected = np.array(mi.render(truth, sensor=sensor, spp=256))
        # The photographs were blurred by a Gaussian of half a large pixel, and have its noise.
        assert np.abs(target.rgba[..., 3] - expected[..., 3]).mean() < 0.004
        assert np.abs(target.rgba[..., :3] - np.minimum(expected[..., :3], 1)).mean() < 0.01


def test_interrupted_import_leaves_nothing(tmp_path):
    write_nerf(tmp_path, known_cameras(3))
    before = sorted(tmp_path.iterdir())

    def interrupt(done, count):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_capture(tmp_path, tmp_path / "out.xml", progress=interrupt)
    assert sorted(tmp_path.iterdir()) == before


def test_full_disk_is_told(tmp_path, monkeypatch):
    write_nerf(tmp_path, known_cameras(3))
    with pytest.raises(OSError, match=r"none|view\.exr"):
        write_target(tmp_path / "none" / "view.exr", np.zeros((4, 4, 4)))

    def full(path, rgba):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("gshell_mi.capture.run.write_target", full)
    with pytest.raises(UserError, match=r"cannot be written \(No space left on device\)"):
        import_capture(tmp_path, tmp_path / "out.xml")
    assert not any("out" in path.name for path in tmp_path.iterdir())


def test_nerfstudios_lists_hold_out(tmp_path):
    write_nerf(tmp_path, known_cameras(4), "nerfstudio")
    document = json.loads((tmp_path / "transforms.json").read_text())
    names = [frame["file_path"] for frame in document["frames"]]
    document |= {"train_filenames": names[:2], "val_filenames": names[2:3], "test_filenames": names[2:]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert [frame.held_out for frame in read_capture(tmp_path).frames] == [False, False, True, True]


def test_file_in_place_of_the_folder(tmp_path):
    write_nerf(tmp_path, known_cameras(2))
    assert len(read_capture(tmp_path / "transforms_train.json").frames) == 2
