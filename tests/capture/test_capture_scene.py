"""The scene that an import writes, what it warns of, and the contact sheet."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from known_capture import BALL, RADIUS, KnownCamera, known_cameras, write_image, write_nerf
from PIL import Image, ImageCms

from gshell_mi.capture import Camera, CaptureConfig, import_capture
from gshell_mi.capture.__main__ import main
from gshell_mi.capture.check import check_scene
from gshell_mi.capture.region import Silhouette, agreement, common_point, find_box
from gshell_mi.capture.trouble import ENOUGH_VIEWS, Thumbnail, find_trouble
from gshell_mi.capture.writer import RECORD, read_record, write_record
from gshell_mi.errors import UserError
from gshell_mi.scene import load_fit_scene

MANY = known_cameras(ENOUGH_VIEWS)
TIGHT = np.stack([BALL - 1.1 * RADIUS, BALL + 1.1 * RADIUS])


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A NeRF capture of twenty training and three test views."""
    folder = tmp_path_factory.mktemp("nerf")
    write_nerf(folder, MANY)
    tests = known_cameras(3)
    document = json.loads((folder / "transforms_train.json").read_text())
    document["frames"] = []
    for index, camera in enumerate(tests):
        write_image(folder / "test" / f"r_{index}.png", camera)
        matrix = np.eye(4)
        matrix[:3] = np.stack([camera.right, camera.up, -camera.forward, camera.origin], axis=1)
        document["frames"].append({"file_path": f"./test/r_{index}", "transform_matrix": matrix.tolist()})
    (folder / "transforms_test.json").write_text(json.dumps(document))
    return folder


@pytest.fixture(scope="module")
def scene(source, tmp_path_factory):
    return import_capture(source, tmp_path_factory.mktemp("scene") / "ball.xml")


def thumbnails(cameras=MANY):
    made = []
    for index, c in enumerate(cameras):
        pose = np.eye(4)
        pose[:3] = np.stack([c.right, -c.up, c.forward, c.origin], axis=1)
        camera = Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, pose)
        made.append(Thumbnail.of(f"view_{index:03}", c.render().astype(np.float32), camera))
    return made


def trouble(views, box=TIGHT):
    return find_trouble(views, box, np.eye(4))


def with_alpha(thumbnail, change):
    rgba = thumbnail.rgba.copy()
    rgba[..., 3] = change(rgba[..., 3])
    return replace(thumbnail, rgba=rgba)


# --- the scene


def test_a_good_capture_raises_no_warning(scene):
    assert scene.warnings == ()
    assert (scene.training, scene.held_out) == (20, 3)


def test_test_views_are_held_out(scene):
    folder = scene.path.with_suffix("")
    assert len(load_fit_scene(scene.path).sensors) == 20
    held_out = mi.load_file(str(folder / "test.xml")).sensors()
    assert [sensor.id() for sensor in held_out] == ["test_000", "test_001", "test_002"]
    truth = known_cameras(3)[1].render()
    image = np.array(mi.Bitmap(str(folder / "test" / "test_001.exr")), dtype=np.float32)
    assert np.abs(image - truth).max() < 0.01


def test_every_nth_view_is_held_out(source, tmp_path):
    shutil.copytree(source, tmp_path / "set")
    (tmp_path / "set" / "transforms_test.json").unlink()
    result = import_capture(tmp_path / "set", tmp_path / "s.xml", config=CaptureConfig(hold_out=8))
    assert (result.training, result.held_out) == (17, 3)
    record = json.loads((tmp_path / "s" / "capture.json").read_text())
    assert [view["image"].split("_")[-1] for view in record["views"] if view["id"].startswith("test")] == [
        "0.png",
        "8.png",
        "16.png",
    ]


def test_paths_with_spaces_and_other_scripts(source, tmp_path, capfd, variant):
    folder = tmp_path / "größe & \"安\" 'x'"
    shutil.copytree(source, folder / "фото 1")
    for number in range(3):
        (folder / "фото 1/test" / f"r_{number}.png").rename(folder / "фото 1/test" / f"é & <{number}>.png")
    path = folder / "фото 1/transforms_test.json"
    path.write_text(
        path.read_text().replace("/r_0", "/é & <0>").replace("/r_1", "/é & <1>").replace("/r_2", "/é & <2>"),
        encoding="utf-8",
    )
    assert (
        main(
            [
                str(folder / "фото 1"),
                "-o",
                str(folder / "szene ü.xml"),
                "--check",
                "--quiet",
                "--variant",
                variant,
            ]
        )
        == 0
    )
    assert "23" not in capfd.readouterr().err
    assert len(load_fit_scene(folder / "szene ü.xml").sensors) == 20
    assert (folder / "szene ü" / "check.png").is_file()
    assert "é & <2>.png" in (folder / "szene ü" / "capture.json").read_text(encoding="utf-8")


def test_given_box_light_and_resolution(source, tmp_path):
    light = np.random.default_rng(0).random((8, 16, 3), dtype=np.float32)
    mi.Bitmap(light).write(str(tmp_path / "sky.exr"))
    config = CaptureConfig(box=(-1, -1, -1, 1, 2, 1), light=tmp_path / "sky.exr", resolution=20)
    fit_scene = load_fit_scene(import_capture(source, tmp_path / "s.xml", config=config).path)
    assert fit_scene.subject.lattice.resolution == 20
    corner = mi.Transform4f(fit_scene.subject.to_world) @ mi.Point3f(1, 1, 1)
    np.testing.assert_allclose(np.array(corner).ravel(), [1.5, 2, 1.5])  # grown to a cube
    (tmp_path / "sky.exr").unlink()
    assert "data" in mi.traverse(load_fit_scene(tmp_path / "s.xml").light)


@pytest.mark.parametrize(
    "up, expected",
    [("auto", [0, 0, 1]), ("z", [0, 0, 1]), ("-x", [-1, 0, 0]), ("cameras", [0, 0, 1]), ("-y", [0, -1, 0])],
)
def test_up_is_turned_to_y(up, expected, source, tmp_path):
    import_capture(source, tmp_path / "s.xml", config=CaptureConfig(up=up))
    matrix = np.array(json.loads((tmp_path / "s" / "capture.json").read_text())["capture_to_scene"])
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1)
    tolerance = 0.06 if up == "cameras" else 1e-12  # twenty cameras are up on average but roughly
    np.testing.assert_allclose(matrix[:3, :3] @ expected, [0, 1, 0], atol=tolerance)


def test_kept_up(source, tmp_path):
    import_capture(source, tmp_path / "s.xml", config=CaptureConfig(up="keep"))
    assert json.loads((tmp_path / "s" / "capture.json").read_text())["capture_to_scene"] == np.eye(4).tolist()


def test_flipped_axes_are_read_as_told(source, tmp_path):
    shutil.copytree(source, tmp_path / "set")
    for name in ("transforms_train.json", "transforms_test.json"):
        document = json.loads((tmp_path / "set" / name).read_text())
        for frame in document["frames"]:
            matrix = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
            frame["transform_matrix"] = matrix.tolist()
        (tmp_path / "set" / name).write_text(json.dumps(document))
    with pytest.raises(UserError, match=r"z axes point the other way .* export them again, or give --opencv"):
        import_capture(tmp_path / "set", tmp_path / "s.xml")
    result = import_capture(tmp_path / "set", tmp_path / "s.xml", config=CaptureConfig(opencv_axes=True))
    assert result.warnings == ()


def test_views_with_empty_masks_are_left_out(source, tmp_path):
    shutil.copytree(source, tmp_path / "set")
    Image.new("RGBA", (60, 44)).save(tmp_path / "set/train/r_7.png")
    result = import_capture(tmp_path / "set", tmp_path / "s.xml")
    assert result.training == 19
    assert "1 view with an empty mask is left out: r_7.png." in result.warnings


def test_views_that_show_the_object_as_a_thread_are_no_obstacle(source, tmp_path):
    """A leaf seen edge-on: at the size at which the box is sought, its mask is gone."""
    write_nerf(tmp_path / "set", known_cameras(4, width=400, height=300, fx=460, fy=460, cx=200, cy=150))
    thread = np.zeros((300, 400, 4), np.uint8)
    thread[100:200, 200] = 255
    Image.fromarray(thread).save(tmp_path / "set/train/r_1.png")
    result = import_capture(tmp_path / "set", tmp_path / "s.xml")
    assert result.training == 4
    np.testing.assert_allclose(result.box.mean(axis=0)[[0, 2, 1]] * [1, -1, 1], BALL, atol=0.15)
    for index in range(4):
        Image.fromarray(thread).save(tmp_path / f"set/train/r_{index}.png")
    with pytest.raises(UserError, match="have no common volume"):
        import_capture(tmp_path / "set", tmp_path / "t.xml")
    boxed = CaptureConfig(box=(-1, -1, -1, 1, 1, 1))
    report = check_scene(import_capture(tmp_path / "set", tmp_path / "t.xml", config=boxed).path)
    assert any("are empty" in warning for warning in report.warnings)
    assert any("no common volume in the box" in warning for warning in report.warnings)


def test_another_colour_profile_is_noticed(source, tmp_path):
    shutil.copytree(source, tmp_path / "set")
    first = tmp_path / "set/train/r_0.png"
    for name, words in (("sRGB", None), ("XYZ", "carry the colour profile 'XYZ")):
        profile = ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes()
        Image.open(first).save(first, icc_profile=profile)
        result = import_capture(tmp_path / "set", tmp_path / "s.xml", overwrite=True)
        assert [words in warning for warning in result.warnings] == ([True] if words else [])
    told = CaptureConfig(color_space="ITU-R BT.709")
    assert import_capture(tmp_path / "set", tmp_path / "t.xml", config=told).warnings == ()


def test_importing_the_package_sets_no_variant():
    code = (
        "import mitsuba as mi, gshell_mi.capture, gshell_mi.capture.__main__, gshell_mi.capture.check; "
        "assert mi.variant() is None"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_geographic_coordinates_keep_their_precision(source, tmp_path):
    """Half a million units away, where single precision resolves a thirtieth."""
    shutil.copytree(source, tmp_path / "set")
    away = np.array([500_000.0, 200_000.0, 80.0])
    for name in ("transforms_train.json", "transforms_test.json"):
        document = json.loads((tmp_path / "set" / name).read_text())
        for frame in document["frames"]:
            for axis in range(3):
                frame["transform_matrix"][axis][3] += away[axis]
        (tmp_path / "set" / name).write_text(json.dumps(document))
    result = import_capture(tmp_path / "set", tmp_path / "s.xml")
    assert result.warnings == () and np.abs(result.box.mean(axis=0)).max() < 1e-6
    matrix = np.array(json.loads((tmp_path / "s" / "capture.json").read_text())["capture_to_scene"])
    for file, cameras in ((tmp_path / "s.xml", MANY), (tmp_path / "s" / "test.xml", known_cameras(3))):
        for sensor, truth in zip(mi.load_file(str(file)).sensors(), cameras, strict=True):
            center = np.array(sensor.world_transform().matrix).reshape(4, 4)[:3, 3]
            expected = matrix[:3, :3] @ (truth.origin + away) + matrix[:3, 3]
            np.testing.assert_allclose(center, expected, atol=1e-5)


@pytest.mark.parametrize(
    "record",
    [
        "[" * 20000,
        '{"views": [{"id": "view_000", "image": 7, "clipped": 0}], "capture_to_scene": %s}',
        '{"views": [{"id": "view_000", "image": "a", "clipped": 1'
        + "0" * 400
        + '}], "capture_to_scene": %s}',
        '{"views": [], "capture_to_scene": [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]}',
    ],
)
def test_a_damaged_record_is_none(record, tmp_path):
    (tmp_path / RECORD).write_text(record.replace("%s", str(np.eye(4).tolist())))
    found = read_record(tmp_path)
    assert found.photographs == {} and (found.to_scene == np.eye(4)).all()


def test_records_hold_names_that_are_not_utf_8(tmp_path):
    view = {"id": "view_000", "image": "/a/\udcffé.png", "clipped": 0.0}
    write_record(tmp_path, {"views": [view], "capture_to_scene": np.eye(4).tolist()})
    assert read_record(tmp_path).photographs == {"view_000": (Path("/a/\udcffé.png"), 0.0)}


# --- where the object is


def test_common_point_of_the_lines_of_sight():
    """The mask of a ball in perspective is centred a little beside its centre's image."""
    silhouettes = [thumbnail.silhouette for thumbnail in thumbnails()]
    np.testing.assert_allclose(common_point(silhouettes), BALL, atol=0.02)
    assert common_point(silhouettes[:1]) is None


def test_box_without_a_hint_and_with_a_wrong_one():
    silhouettes = [thumbnail.silhouette for thumbnail in thumbnails()]
    for region in (None, np.stack([BALL - 0.2, BALL + 0.3]), np.stack([BALL - 2.5, BALL + 3])):
        box = find_box(silhouettes, region)
        np.testing.assert_allclose(box.mean(axis=0), BALL, atol=0.05)
        assert RADIUS < np.ptp(box, axis=0)[0] / 2 < 1.25 * RADIUS
        assert agreement(silhouettes, box).min() == 1


def test_a_wrong_mask_disagrees():
    silhouettes = [thumbnail.silhouette for thumbnail in thumbnails()]
    alpha = silhouettes[4].alpha.copy()
    alpha[:12, :12] = 1
    silhouettes[4] = Silhouette(silhouettes[4].camera, alpha)
    share = agreement(silhouettes, find_box(silhouettes))
    assert share.argmin() == 4 and share[4] < 0.95 and np.delete(share, 4).min() > 0.95


# --- trouble


def test_nothing_wrong_nothing_said():
    assert trouble(thumbnails()) == []


def test_few_views():
    assert "only 12 training views" in trouble(thumbnails(known_cameras(12)))[0]


def test_box_that_misses_the_object():
    found = trouble(thumbnails(), TIGHT + np.array([0.9, 0, 0]))
    assert len(found) == 1 and "The box misses the object" in found[0]


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda pose: pose @ np.diag([1, -1, -1, 1]), "y and z axes point the other way"),
        (np.linalg.inv, "world-to-camera"),
        (lambda pose: pose @ np.diag([-1, -1, 1, 1]), "upside down"),
    ],
)
def test_misread_cameras_are_told_apart(change, words):
    """With a box that all rays meet, so that it is not to blame."""
    views = [replace(t, camera=replace(t.camera, to_world=change(t.camera.to_world))) for t in thumbnails()]
    found = trouble(views, np.array([[-9.0] * 3, [9.0] * 3]))
    assert any("The cameras look misread" in sentence and words in sentence for sentence in found)


def test_images_in_another_order_do_not_agree():
    views = thumbnails()
    shuffled = [replace(t, camera=views[(i * 7) % 20].camera) for i, t in enumerate(views)]
    found = trouble(shuffled, np.array([[-9.0] * 3, [9.0] * 3]))
    assert any("do not agree on a common volume" in sentence for sentence in found)


def test_masks_empty_inverted_or_full():
    views = thumbnails()
    views[2] = with_alpha(views[2], lambda alpha: 0 * alpha)
    views[5] = with_alpha(views[5], lambda alpha: 1 - alpha)
    views[7] = with_alpha(views[7], lambda alpha: 0 * alpha + 1)
    found = trouble(views)
    assert any("view_002 are empty" in sentence for sentence in found)
    assert any("view_005 seem inverted" in sentence for sentence in found)
    assert any("view_007 cover the whole image" in sentence for sentence in found)


def test_images_of_one_colour_and_clipped_ones():
    views = thumbnails()
    grey = views[3].rgba.copy()
    grey[..., :3] = 0.4 * grey[..., 3:]
    views[3] = replace(views[3], rgba=grey)
    views[6] = replace(views[6], clipped=0.3)
    found = trouble(views)
    assert any("view_003 are nearly all one colour" in sentence for sentence in found)
    assert any("clipped in view_006 (up to 30 %" in sentence for sentence in found)


def test_views_from_one_side():
    cameras = [c for c in known_cameras(120) if c.origin[2] > BALL[2] + 2.2]
    assert any("from one side" in sentence for sentence in trouble(thumbnails(cameras[:20])))


# --- the contact sheet


def colored(picture, color):
    return (np.array(Image.open(picture).convert("RGB")) == color).all(axis=-1)


def test_contact_sheet_draws_hull_and_box_over_the_object(scene):
    report = check_scene(scene.path)
    assert report.warnings == ()
    sheet = np.array(Image.open(report.picture).convert("RGB"))
    assert sheet.shape[1] > 1000
    # The hull's outline encloses the ball in the first tile.
    hull = colored(report.picture, (255, 0, 200))
    rows, columns = np.nonzero(hull)
    tile = (columns < 12 + 240) & (rows < rows.min() + 240)
    truth = MANY[0].render()[..., 3] >= 0.5
    height, width = np.ptp(rows[tile]), np.ptp(columns[tile])
    scale = 240 / 60
    assert abs(width / scale - truth.any(axis=0).sum()) < 1.5
    assert abs(height / scale - truth.any(axis=1).sum()) < 1.5
    assert colored(report.picture, (255, 150, 0)).sum() > 2000


def test_contact_sheet_of_a_scene_from_elsewhere(bowl_scene, tmp_path, capfd, variant):
    """Without a record of an import, and with the option alone."""
    shutil.copytree(bowl_scene.parent, tmp_path / "copy")
    path = tmp_path / "copy" / bowl_scene.name
    assert main([str(path), "--check", "--variant", variant]) == 0
    said = capfd.readouterr()
    assert "only 12 training views" in said.err
    assert (path.with_suffix("") / "check.png").is_file()
    assert main([str(tmp_path), "--check", "--variant", variant]) == 2


def test_contact_sheet_of_a_hopeless_scene(source, tmp_path):
    config = CaptureConfig(box=(5, 5, 5, 6, 6, 6))
    result = import_capture(source, tmp_path / "s.xml", config=config)
    assert any("box misses" in warning for warning in result.warnings)
    report = check_scene(result.path)
    assert any("no common volume in the box" in warning for warning in report.warnings)
    assert not colored(report.picture, (255, 0, 200)).any()


def test_known_camera_is_what_it_says():
    """The tests' own truth: the ball's image is centred where its centre projects, seen head-on."""
    origin, forward, up = BALL + np.array([0, 0, 4]), np.array([0, 0, -1.0]), np.array([0, 1.0, 0])
    camera = KnownCamera(origin, forward, up, cx=33, cy=20)
    alpha = camera.render()[..., 3]
    v, u = np.mgrid[0.5:44, 0.5:60]
    np.testing.assert_allclose(
        [(alpha * u).sum() / alpha.sum(), (alpha * v).sum() / alpha.sum()], [33, 20], atol=1e-6
    )
