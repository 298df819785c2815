"""Photographed captures: that each fault is what it says, alone, and that the truth is the truth."""

import dataclasses
import json
import math
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from gshell_mi.capture import CaptureConfig, import_capture
from gshell_mi.errors import UserError
from gshell_mi.scene import load_fit_scene

REPOSITORY = Path(__file__).parents[2]
sys.path.insert(0, str(REPOSITORY / "pipelines"))

import make_photographed_capture  # noqa: E402
from scene_builder import faults as wrong  # noqa: E402
from scene_builder.faults import CLEAN, Dice, Faults  # noqa: E402
from scene_builder.finish import finished, load_subject  # noqa: E402
from scene_builder.photographs import Photographs, views_around, write_photographs  # noqa: E402

REFERENCE = REPOSITORY / "scenes" / "skirt" / "reference.xml"
VIEWS, SIZE = 8, 64


def only(**sizes: float) -> Faults:
    """The faults that are named, and no others."""
    return dataclasses.replace(CLEAN, **sizes)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Writes a tiny capture of given faults, once; returns its folder."""
    written = {}

    def write(faults: Faults) -> Path:
        if faults not in written:
            place = tmp_path_factory.mktemp("photographs") / "skirt"
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("gshell_mi.scene.REFERENCE_SPP", 1)
                write_photographs(Photographs(REFERENCE, faults, VIEWS, SIZE, 4), place)
            written[faults] = place
        return written[faults]

    return write


def frames(folder: Path) -> list[dict]:
    return json.loads((folder / "capture" / "transforms.json").read_text())["frames"]


def truths(folder: Path) -> list[dict]:
    return json.loads((folder / "truth" / "faults.json").read_text())["frames"]


def pixels(folder: Path, what: str) -> np.ndarray:
    """(views, h, w[, 3]) in steps of 1/255."""
    return np.array(
        [np.array(Image.open(path), float) for path in sorted((folder / "capture" / what).iterdir())]
    )


def linear(encoded: np.ndarray) -> np.ndarray:
    value = encoded / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def poses(entries: list[dict]) -> np.ndarray:
    return np.array([entry["transform_matrix"] for entry in entries])


# --- the faults themselves


def test_poses_are_off_by_as_much_as_told():
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix()
    pose[:3, 3] = [1.0, 2.0, 2.0]
    rng = np.random.default_rng(1)
    found = np.array([wrong.wrong_pose(pose, 0.5, 2.0, rng) for _ in range(2000)])
    turn = Rotation.from_matrix(found[:, :3, :3] @ pose[:3, :3].T).magnitude()
    move = np.linalg.norm(found[:, :3, 3] - pose[:3, 3], axis=1)
    assert math.degrees(np.sqrt((turn**2).mean())) == pytest.approx(0.5, rel=0.05)
    assert np.sqrt((move**2).mean()) == pytest.approx(0.02 * 3.0, rel=0.05)
    assert np.array_equal(wrong.wrong_pose(pose, 0.0, 0.0, rng), pose)


def test_exposures_differ_by_as_much_as_told():
    dice = Dice(0)
    found = [wrong.exposure(0.25, 3.0, dice("exposure", view)) for view in range(2000)]
    stops, balance = np.array([s for s, _ in found]), np.array([b for _, b in found])
    assert stops.std() == pytest.approx(0.25, rel=0.05) and abs(stops.mean()) < 0.02
    assert balance.prod(1) == pytest.approx(1.0)
    # Taking the mean out leaves two thirds of the variance.
    assert np.log(balance).std() == pytest.approx(0.03 * math.sqrt(2 / 3), rel=0.05)
    assert wrong.exposure(0.0, 0.0, dice("exposure")) == (0.0, pytest.approx(np.ones(3)))


def test_masks_are_eroded_by_as_many_pixels_as_told():
    y, x = np.mgrid[:96, :96] - 47.5
    disc = (np.hypot(x, y) < 30).astype(float)
    eroded = wrong.wrong_mask(disc, 0.0, 4.0, np.random.default_rng(0))
    assert np.sqrt(eroded.sum() / np.pi) == pytest.approx(26.0, abs=0.4)
    half = (x < 0).astype(float)
    assert wrong.wrong_mask(half, 0.0, 3.0, np.random.default_rng(0))[50].sum() == 48 - 3
    assert np.array_equal(wrong.wrong_mask(0.4 * half, 0.0, 0.0, np.random.default_rng(0)), 0.4 * half)


def test_masks_waver_by_as_many_pixels_as_told():
    half = np.zeros((400, 400))
    half[:, :200] = 1
    wavering = wrong.wrong_mask(half, 2.0, 0.0, np.random.default_rng(0))
    edge = wavering.sum(1) - 200
    assert np.sqrt((edge**2).mean()) == pytest.approx(2.0, rel=0.35)
    assert np.abs(np.diff(edge)).max() <= 2, "it wavers, it is not noise"


def test_relief_is_as_high_as_told_and_finer_than_a_cell():
    subject = load_subject(REFERENCE)
    plain = finished(subject, only(print=1.0), Dice(0))
    pressed = finished(subject, only(relief=0.4, print=1.0), Dice(0))
    assert np.array_equal(plain.faces, pressed.faces) and np.array_equal(plain.color, pressed.color)
    height = np.linalg.norm(pressed.vertices - plain.vertices, axis=1) / subject.extent
    assert height.max() == pytest.approx(0.004, rel=0.01)
    assert np.sqrt((height**2).mean()) == pytest.approx(0.002, rel=0.1)
    assert plain.color.min() >= 0 and plain.color.max() <= 1
    changed = np.abs(finished(subject, only(relief=0.4), Dice(0)).color - plain.color).max(1)
    assert np.percentile(changed, 20) < 0.05 < 0.1 < np.percentile(changed, 80), "ink here, cloth there"


def test_gloss_and_none():
    subject = load_subject(REFERENCE)
    assert finished(subject, only(gloss=0.75), Dice(0)).roughness == pytest.approx(0.25 * subject.roughness)
    same = finished(subject, CLEAN, Dice(0))
    assert same.vertices is subject.vertices and same.color is subject.color
    assert (same.roughness, same.metallic) == (subject.roughness, subject.metallic)


def test_close_ups_cut_the_object_off_and_other_views_do_not():
    vertices = load_subject(REFERENCE).vertices
    views = views_around(vertices, 40, 0.25, Dice(0))
    assert sum(view.close_up for view in views) == 10
    for view in views:
        at = (vertices - view.pose[:3, 3]) @ view.pose[:3, :3]
        reach = np.abs(at[:, :2] / at[:, 2:]).max() / math.tan(math.radians(20))
        assert (reach > 1) == view.close_up


def test_faults_do_not_depend_on_each_other():
    dice = Dice(3)
    before = dice("pose", 7).standard_normal(4)
    dice("mask", 7).standard_normal(100)
    assert np.array_equal(dice("pose", 7).standard_normal(4), before)
    for other in (dice("mask", 7), dice("pose", 8), Dice(4)("pose", 7)):
        assert not np.array_equal(other.standard_normal(4), before)


@pytest.mark.parametrize(
    ("size", "complaint"),
    [
        ({"noise": -1.0}, "--noise must not be negative, and is -1"),
        ({"gloss": 2.0}, "--gloss must lie in 0 to 0.95, and is 2"),
        ({"mask_pixels": math.nan}, "--mask-pixels must not be negative, and is nan"),
    ],
)
def test_sizes_that_are_none(size, complaint):
    with pytest.raises(UserError, match=complaint):
        Faults(**size)


# --- whole captures


def test_clean_capture_is_the_truth(photographs, tmp_path):
    folder = photographs(CLEAN)
    assert np.array_equal(poses(frames(folder)), poses(truths(folder)))
    assert all(entry["exposure_stops"] == 0 and not entry["close_up"] for entry in truths(folder))
    assert len(list((folder / "capture" / "images").glob("*.png"))) == VIEWS
    assert len(list((folder / "truth" / "test").glob("test_*.exr"))) == 12
    result = import_capture(folder / "capture", tmp_path / "skirt.xml", config=CaptureConfig(max_size=0))
    assert (result.training, result.held_out) == (VIEWS, 0)
    # The truth lies in the frame that the import puts the cameras into.
    reference = mi.load_file(str(folder / "truth" / "reference.xml"))
    scene = load_fit_scene(result.path)
    for sensor, target in zip(scene.sensors, scene.targets, strict=True):
        expected = np.array(mi.render(reference, sensor=sensor, spp=64))[..., 3] > 0.5
        found = target.rgba[..., 3] > 0.5
        assert (expected & found).sum() > 0.97 * (expected | found).sum()


def test_exposure_scales_the_light_and_nothing_else(photographs):
    clean, folder = photographs(CLEAN), photographs(only(exposure_stops=0.5))
    before, after = linear(pixels(clean, "images")), linear(pixels(folder, "images"))
    stops = np.array([entry["exposure_stops"] for entry in truths(folder)])
    assert np.abs(stops).max() > 0.3
    for first, second, stop in zip(before, after, stops, strict=True):
        readable = (first > 0.05) & (second > 0.05) & (first < 0.95) & (second < 0.95)
        assert np.median(second[readable] / first[readable]) == pytest.approx(2**stop, rel=0.02)
    assert np.array_equal(pixels(folder, "masks"), pixels(clean, "masks"))


def test_pose_errors_are_in_the_poses_alone(photographs):
    clean, folder = photographs(CLEAN), photographs(only(pose_degrees=1.0, pose_percent=1.0))
    found, true = poses(frames(folder)), poses(truths(folder))
    assert np.array_equal(true, poses(truths(clean)))
    turn = Rotation.from_matrix(found[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)).magnitude()
    assert 0.5 < math.degrees(np.sqrt((turn**2).mean())) < 1.6
    move = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1) / np.linalg.norm(true[:, :3, 3], axis=1)
    assert 0.005 < np.sqrt((move**2).mean()) < 0.016
    assert np.array_equal(pixels(folder, "masks"), pixels(clean, "masks"))


def test_stand_hides_the_lower_rim_in_level_views_only(photographs):
    clean, folder = photographs(CLEAN), photographs(only(stand=8.0))
    # z is up in the capture.
    height = np.array([pose[2, 3] / np.linalg.norm(pose[:3, 3]) for pose in poses(frames(folder))])
    level = np.abs(height) < math.sin(math.radians(wrong.LEVEL_DEGREES))
    assert 0 < level.sum() < VIEWS
    for first, second, is_level in zip(pixels(clean, "masks"), pixels(folder, "masks"), level, strict=True):
        if not is_level:
            assert np.array_equal(first, second)
            continue
        gone = first - second
        assert gone.min() >= 0 and gone.sum() > 0.01 * first.sum()
        rows = np.nonzero(first.any(1))[0]
        assert not gone[: int(rows[0] + 0.6 * np.ptp(rows))].any(), "only what is low"


def test_noise_is_as_strong_as_told(photographs):
    noisy = pixels(photographs(only(noise=6.0)), "images")
    difference = noisy - pixels(photographs(CLEAN), "images")
    readable = (noisy > 40) & (noisy < 215)
    assert difference[readable].std() == pytest.approx(6.0, rel=0.1)


def test_the_same_again_and_all_faults_at_once(photographs, tmp_path, monkeypatch):
    folder = photographs(Faults())
    monkeypatch.setattr("gshell_mi.scene.REFERENCE_SPP", 1)
    write_photographs(Photographs(REFERENCE, Faults(), VIEWS, SIZE, 4), tmp_path / "again")
    assert frames(folder) == frames(tmp_path / "again") and truths(folder) == truths(tmp_path / "again")
    assert np.array_equal(pixels(folder, "masks"), pixels(tmp_path / "again", "masks"))
    assert len(list((folder / "capture" / "images").glob("*.jpg"))) == VIEWS
    assert sum(entry["close_up"] for entry in truths(folder)) == round(VIEWS * Faults().close_ups)
    result = import_capture(folder / "capture", tmp_path / "skirt.xml")
    assert result.training == VIEWS


def test_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("gshell_mi.scene.REFERENCE_SPP", 1)
    quick = ["--views", "4", "--size", "16", "--spp", "1"]
    command = [str(REFERENCE), str(tmp_path / "skirt"), *quick, "--clean", "--mask-erosion", "1"]
    assert make_photographed_capture.main(command) == 0
    sizes = json.loads((tmp_path / "skirt" / "truth" / "faults.json").read_text())["sizes"]
    assert sizes == dataclasses.asdict(only(mask_erosion=1.0))
    capsys.readouterr()
    for mistaken, complaint in (
        (command, f"'{tmp_path / 'skirt'}' exists already; name a new folder."),
        ([*command[:1], str(tmp_path / "b"), "--stand", "80"], "--stand must lie in 0 to 50, and is 80."),
        (["none.xml", str(tmp_path / "b")], "'none.xml' does not exist; give a scene's reference.xml."),
        ([*command[:1], str(tmp_path / "b"), "--views", "1"], "A capture takes at least 4 views"),
    ):
        assert make_photographed_capture.main(mistaken) == 2
        assert complaint in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["skirt"], "nothing is left behind"
