"""Cameras of photographs that come without."""

import json
import os
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import photographed
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from gshell_mi.capture import structure_from_motion
from gshell_mi.capture.__main__ import main
from gshell_mi.capture.frames import Capture
from gshell_mi.capture.stationary import stationary_features
from gshell_mi.capture.structure_from_motion import photographs_in, place
from gshell_mi.capture.workspace import Workspace
from gshell_mi.errors import UserError
from gshell_mi.scene import load_fit_scene

needs_extras = pytest.mark.skipif(
    find_spec("pycolmap") is None or find_spec("cv2") is None, reason="needs the extras 'colmap' and 'masks'"
)


def test_colmap_ends_with_a_command_that_is_killed(tmp_path):
    """Or the same command, given again, would make it work in one folder twice."""
    pytest.importorskip("pycolmap", reason="needs the extra 'colmap'")
    os.mkfifo(tmp_path / "job.json")  # it waits for what nobody writes
    start = (
        "import subprocess, sys; worker = subprocess.Popen([sys.executable, '-m', "
        "'gshell_mi.capture.colmap_worker', sys.argv[1]], stdout=subprocess.PIPE); "
        "print(worker.pid, flush=True); worker.wait()"
    )
    with subprocess.Popen([sys.executable, "-c", start, str(tmp_path)], stdout=subprocess.PIPE) as command:
        worker = Path(f"/proc/{int(command.stdout.readline())}")
        reader = os.open(tmp_path / "job.json", os.O_WRONLY)  # opens once the worker reads
        assert worker.exists()
        command.kill()
    for _ in range(100):
        if not worker.exists():
            break
        time.sleep(0.1)
    os.close(reader)
    assert not worker.exists()


def tracks(cameras, points, rng):
    """Keypoints and matches of points seen by cameras, with wrong matches among them."""
    keypoints = {
        i: camera.project(points) + 0.3 * rng.standard_normal((len(points), 2))
        for i, camera in enumerate(cameras)
    }
    right = np.stack([np.arange(len(points))] * 2, axis=1)
    return keypoints, {
        (i, j): np.concatenate([right, rng.integers(len(points), size=(20, 2))])
        for i in range(len(cameras))
        for j in range(i + 1, len(cameras))
    }


def test_nothing_stands_still_for_a_camera_that_goes_around():
    rng = np.random.default_rng(0)
    points = np.concatenate([photographed.points(), 30 * rng.standard_normal((200, 3))])
    still = stationary_features(*tracks(photographed.cameras(30), points, rng), 320)
    assert max(flags.mean() for flags in still.values()) < 0.02


def test_a_room_around_a_turntable_stands_still():
    """Photographs from one place, the camera nudged in between; half of the points turn, half do not."""
    rng = np.random.default_rng(0)
    turning, cameras = photographed.points()[:300], photographed.cameras(24)
    on_table, matches = tracks(cameras, turning, rng)
    room = rng.uniform([0, 0], [320, 240], (150, 2))
    keypoints, pairs = {}, {}
    for i, points in on_table.items():
        nudge = rng.uniform(-8, 8, 2)
        keypoints[i] = np.concatenate([points, room + nudge + 0.3 * rng.standard_normal(room.shape)])
    for pair, match in matches.items():
        pairs[pair] = np.concatenate([match, np.stack([300 + np.arange(150)] * 2, axis=1)])
    still = stationary_features(keypoints, pairs, 320)
    assert np.mean([flags[300:].mean() for flags in still.values()]) > 0.98
    assert np.mean([flags[:300].mean() for flags in still.values()]) < 0.05


def test_missing_extra_is_named(tmp_path, monkeypatch, capfd, variant):
    for index, camera in enumerate(photographed.cameras(3, 32, 24)):
        Image.fromarray(photographed.photograph(camera)[0]).save(tmp_path / f"{index}.jpg")
    monkeypatch.setattr(structure_from_motion.importlib.util, "find_spec", lambda name: None)
    assert main([str(tmp_path), "-o", str(tmp_path / "out" / "s.xml"), "--quiet", "--variant", variant]) == 2
    message = capfd.readouterr().err
    assert "has no cameras" in message and "pip install 'gshell_mi[colmap]'" in message


@needs_extras
def test_too_few_photographs(tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg")
    with pytest.raises(UserError, match="only 1 photographs"):
        place(photographs_in(tmp_path), tmp_path, Workspace(tmp_path / "s.work"))


@needs_extras
def test_photographs_of_nothing_find_no_cameras(tmp_path):
    for index in range(3):
        Image.new("RGB", (64, 48), (90, 90, 90)).save(tmp_path / f"{index}.jpg")
    with pytest.raises(UserError, match="COLMAP found no cameras"):
        place(photographs_in(tmp_path), tmp_path, Workspace(tmp_path / "out" / "s.work"))


@needs_extras
def test_photographs_of_one_size_and_focal_length_share_a_camera(tmp_path):
    for index, (size, focal) in enumerate([((64, 48), 24), ((48, 64), 24), ((64, 48), 50), ((64, 48), 24)]):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA405] = focal
        Image.new("RGB", size, (90, 90, 90)).save(tmp_path / f"{index}.jpg", exif=exif)
    with pytest.raises(UserError, match="COLMAP found no cameras"):
        place(photographs_in(tmp_path), tmp_path, Workspace(tmp_path / "out" / "s.work"))
    with closing(sqlite3.connect(tmp_path / "out" / "s.work" / "colmap" / "features.db")) as base:
        rows = base.execute(
            "SELECT name, params, width FROM images JOIN cameras USING (camera_id) ORDER BY name"
        )
        focal, width = zip(*((np.frombuffer(params)[0], width) for _, params, width in rows), strict=True)
        assert base.execute("SELECT COUNT(*) FROM cameras").fetchone() == (3,)
    np.testing.assert_allclose(focal, np.array([24, 24, 50, 24]) / 36 * 64)
    assert width == (64, 48, 64, 64)


def test_many_photographs_are_neighbours_by_the_numbers_in_their_names(tmp_path, monkeypatch):
    """And that only neighbours are compared is told."""
    for index in range(5):
        Image.new("RGB", (64, 48)).save(tmp_path / f"IMG_{8 + index}.jpg")
    jobs, empty = [], Capture("test", tmp_path, ())
    monkeypatch.setattr(structure_from_motion, "_ALL_PAIRS", 4)
    monkeypatch.setattr(structure_from_motion, "_run_colmap", lambda folder, job, progress: jobs.append(job))
    monkeypatch.setattr(structure_from_motion, "_largest", lambda *_: (empty, tmp_path))
    monkeypatch.setattr(structure_from_motion.importlib.util, "find_spec", lambda name: name)
    photographs = photographs_in(tmp_path)
    capture, _ = place(photographs, tmp_path, Workspace(tmp_path / "s.work"))
    names = [photographs[int(name.removesuffix(".jpg"))].name for name in jobs[0]["images"]]
    assert names == [f"IMG_{8 + index}.jpg" for index in range(5)] and jobs[0]["sequential"]
    assert "5 photographs are too many" in capture.notes[0]


def aligned_errors(found, true):
    """Degrees and relative distances that remain after the best similarity, per camera."""
    a, b = (np.array([camera.center for camera in cameras]) for cameras in (found, true))
    turn, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
    moved = turn.apply(a - a.mean(axis=0))
    scale = (moved * (b - b.mean(axis=0))).sum() / (moved**2).sum()
    off = np.linalg.norm(scale * moved - (b - b.mean(axis=0)), axis=1)
    angles = [
        (
            Rotation.from_matrix(t.to_world[:3, :3]).inv() * turn * Rotation.from_matrix(f.to_world[:3, :3])
        ).magnitude()
        for f, t in zip(found, true, strict=True)
    ]
    return np.degrees(angles), off / np.linalg.norm(b - b.mean(axis=0), axis=1).mean()


@needs_extras
@pytest.mark.slow
def test_mere_photographs_become_a_scene(tmp_path, monkeypatch, capfd, variant):
    """One command: cameras, masks, the table's normal as up, check.png; a second one repeats no step."""
    cameras, truth = photographed.cameras(20), {}
    folder = tmp_path / "photos, Möbel"
    folder.mkdir()
    for index, camera in enumerate(cameras):
        image, mask = photographed.photograph(camera)
        Image.fromarray(image).save(folder / f"IMG {index:02}.jpg", quality=95)
        truth[f"IMG {index:02}.jpg"] = mask >= 0.5
    before = {path: path.read_bytes() for path in folder.iterdir()}
    command = [
        str(folder),
        "-o",
        str(tmp_path / "out" / "s.xml"),
        "--quiet",
        "--variant",
        variant,
        "--hold-out",
        "8",
        "--max-size",
        "0",
    ]
    assert main(command) == 0
    assert "cameras and masks" in capfd.readouterr().out
    assert (tmp_path / "out" / "s" / "check.png").is_file()
    record = json.loads((tmp_path / "out" / "s" / "capture.json").read_text())
    assert sum(view["id"].startswith("test_") for view in record["views"]) == 3
    scene = load_fit_scene(tmp_path / "out" / "s.xml")
    names = {view["id"]: view["image"].rsplit("/")[-1] for view in record["views"]}
    overlaps = [
        photographed.overlap(target.rgba[..., 3] >= 0.5, truth[names[sensor.id()]])
        for sensor, target in zip(scene.sensors, scene.targets, strict=True)
    ]
    assert len(overlaps) == 17 and np.mean(overlaps) > 0.95
    capture, _ = place(photographs_in(folder), folder, Workspace(tmp_path / "out" / "s.work"))
    degrees, distances = aligned_errors([frame.camera for frame in capture.frames], cameras)
    assert np.median(degrees) < 0.3 and np.median(distances) < 0.01
    to_scene = np.array(record["capture_to_scene"])[:3, :3]
    ups = [
        to_scene @ capture.frames[k].camera.to_world[:3, :3] @ cameras[k].to_world[:3, :3].T @ [0, 1, 0]
        for k in range(len(cameras))
    ]
    assert np.mean(ups, axis=0)[1] > 0.999
    monkeypatch.setattr(structure_from_motion, "_run_colmap", None)
    assert main([*command, "--overwrite"]) == 0
    assert before == {path: path.read_bytes() for path in folder.iterdir()}


@needs_extras
@pytest.mark.slow
def test_a_video_becomes_a_scene(tmp_path, variant):
    video = tmp_path / "around.mp4"
    writer = imageio_ffmpeg.write_frames(str(video), (320, 240), fps=24, codec="libx264", quality=9)
    writer.send(None)
    for camera in photographed.cameras(60)[::2]:
        writer.send(np.ascontiguousarray(photographed.photograph(camera)[0]).tobytes())
    writer.close()
    assert (
        main([str(video), "-o", str(tmp_path / "s.xml"), "--quiet", "--variant", variant, "--frames", "24"])
        == 0
    )
    assert len(load_fit_scene(tmp_path / "s.xml").sensors) >= 22
    assert "gshell_mi.capture" in (tmp_path / "s.work" / "steps.json").read_text()


def test_interrupt_ends_the_worker(tmp_path, monkeypatch):
    """Ctrl-C while COLMAP works leaves no process behind."""
    started = []
    real = structure_from_motion.subprocess.Popen

    def sleeper(command, **options):
        started.append(real([sys.executable, "-c", "import time; time.sleep(600)"], **options))
        return started[0]

    def interrupt(*state):
        raise KeyboardInterrupt

    monkeypatch.setattr(structure_from_motion.subprocess, "Popen", sleeper)
    (tmp_path / "mapping.progress").write_bytes(b".")
    with pytest.raises(KeyboardInterrupt):
        structure_from_motion._run_colmap(tmp_path, {"images": ["a", "b", "c"]}, interrupt)
    assert started[0].returncode is not None
