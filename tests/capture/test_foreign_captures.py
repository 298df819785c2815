"""Captures as other programs and other machines write them; each with what has to come out."""

import json
import re
import shutil

import mitsuba as mi
import numpy as np
import pytest
import tifffile
from known_capture import BALL, RADIUS, known_cameras, straight_png, write_colmap, write_idr, write_nerf
from PIL import Image, ImageOps

from gshell_mi.capture import CaptureConfig, read_capture
from gshell_mi.capture.__main__ import main
from gshell_mi.capture.camera import Camera
from gshell_mi.capture.evidence import read_ignored
from gshell_mi.capture.formats import colmap
from gshell_mi.capture.frames import Frame
from gshell_mi.capture.masks import assign_masks, coverage_of
from gshell_mi.capture.run import import_capture
from gshell_mi.capture.white import ignored_white_of, white_of
from gshell_mi.errors import UserError
from gshell_mi.scene import load_fit_scene

CAMERAS = known_cameras(8, width=16, height=12, fx=20.0, fy=20.0, cx=8.0, cy=6.0)


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    folder = tmp_path_factory.mktemp("originals")
    write_nerf(folder / "nerf", CAMERAS, "nerfstudio")
    write_colmap(folder / "colmap", CAMERAS, binary=False)
    return folder


@pytest.fixture
def nerf(originals, tmp_path):
    return shutil.copytree(originals / "nerf", tmp_path / "nerf")


@pytest.fixture
def model(originals, tmp_path):
    return shutil.copytree(originals / "colmap", tmp_path / "colmap")


def change(folder, edit):
    path = folder / "transforms.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    edit(document)
    path.write_text(json.dumps(document), encoding="utf-8")


def names(capture, held_out):
    return [frame.image.name for frame in capture.frames if frame.held_out == held_out]


# --- split lists


@pytest.mark.parametrize("spelling", ["images/{}", "./images/{}", "images\\{}", "images/../images/{}"])
def test_split_lists_may_spell_names_in_another_way(spelling, nerf):
    files = [f"frame_{k:05}.png" for k in range(8)]

    def edit(document):
        document["train_filenames"] = [spelling.format(name) for name in files[:5]]
        document["val_filenames"] = [spelling.format(name) for name in files[5:]]

    change(nerf, edit)
    capture = read_capture(nerf)
    assert (names(capture, False), names(capture, True)) == (files[:5], files[5:])


def test_what_no_list_trains_on_is_held_out(nerf):
    change(nerf, lambda d: d.update(train_filenames=["images/frame_00001.png"]))
    assert names(read_capture(nerf), False) == ["frame_00001.png"]


@pytest.mark.parametrize(
    "value, words",
    [
        (["images/none.png"], "is missing"),
        (5, "is no list of file names"),
        (True, "is no list"),
        ([["images/frame_00001.png"]], "is no list"),
        (["images/extra.png"], "which no frame shows"),
    ],
)
def test_lists_that_match_nothing(value, words, nerf):
    shutil.copy(nerf / "images/frame_00001.png", nerf / "images/extra.png")
    change(nerf, lambda d: d.update(val_filenames=value))
    with pytest.raises(UserError, match=words):
        read_capture(nerf)


# --- numbers and names in JSON


@pytest.mark.parametrize(
    "text",
    [
        '{"frames": ' + "[" * 100_000,
        '{"w": ' + "9" * 5000 + "}",
        '{"frames": [{"file_path": "/", "transform_matrix": []}]}',
        '{"frames": [{"file_path": "images/frame_00001.png", "transform_matrix": [[' + "9" * 400 + "]]}]}",
        '{"w": '
        + "9" * 400
        + ', "frames": [{"file_path": "images/frame_00001.png", "transform_matrix": '
        + json.dumps(np.eye(4).tolist())
        + "}]}",
    ],
)
def test_documents_that_break_readers(text, nerf, tmp_path, capfd):
    (nerf / "transforms.json").write_text(text, encoding="utf-8")
    assert main([str(nerf), "-o", str(tmp_path / "a.xml")]) == 2
    assert re.fullmatch(r"error: .*\.", capfd.readouterr().err.strip())


# --- other copies of the images


def test_images_may_be_somewhere_else(nerf, tmp_path):
    """In half the size, while the JSON has paths of another machine."""
    half = tmp_path / "images_2"
    half.mkdir()
    for camera, frame in zip(CAMERAS, range(8), strict=True):
        rgba = Image.fromarray(straight_png(camera.render()))
        rgba.resize((8, 6)).save(half / f"frame_{frame:05}.png")

    def edit(document):
        for frame in document["frames"]:
            frame["file_path"] = "D:\\scans\\" + frame["file_path"].replace("/", "\\")

    change(nerf, edit)
    with pytest.raises(UserError, match=r"is missing.* name the folder of the images with --images"):
        read_capture(nerf)
    capture = read_capture(nerf, images=half)
    assert {frame.image.parent for frame in capture.frames} == {half}
    assert capture.frames[0].camera.fx == pytest.approx(CAMERAS[0].fx / 2)
    (half / "frame_00003.png").unlink()
    with pytest.raises(UserError, match=r"frame_00003.png' of frame 3 .* is not in"):
        read_capture(nerf, images=half)


# --- COLMAP's text


def test_models_without_lines_of_keypoints(model):
    path = model / "sparse" / "0" / "images.txt"
    whole = read_capture(model)
    lines = path.read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if "IMG" in line]
    path.write_text("\n".join(kept), encoding="utf-8")
    assert len(kept) == len(whole.frames) == len(CAMERAS)
    assert [f.image for f in read_capture(model).frames] == [f.image for f in whole.frames]


def test_empty_lines_and_comments_before_images_do_not_count(model):
    path = model / "sparse" / "0" / "images.txt"
    path.write_text("# a comment\n\n" + path.read_text(encoding="utf-8"), encoding="utf-8-sig")
    assert len(read_capture(model).frames) == len(CAMERAS)


def test_keypoints_that_are_cut_off(model):
    path = model / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text(encoding="utf-8") + "1.0 2.0\n", encoding="utf-8")
    with pytest.raises(UserError, match=r"images.txt' is malformed in line"):
        read_capture(model)


def test_byte_order_mark(model):
    path = model / "sparse" / "0" / "cameras.txt"
    path.write_text(path.read_text(encoding="utf-8"), encoding="utf-8-sig")
    assert len(read_capture(model).frames) == len(CAMERAS)


def test_lines_of_images_that_end_in_another_way(model):
    """Spaces after a name, and the line ends of Windows and of old Macs."""
    path = model / "sparse" / "0" / "images.txt"
    text, before = path.read_text(encoding="utf-8"), read_capture(model).frames
    for end in ("  \n", "\r\n", "\r"):
        path.write_bytes(text.replace("\n", end).encode())
        assert [frame.image for frame in read_capture(model).frames] == [frame.image for frame in before]


@pytest.mark.parametrize(
    "edit, words",
    [
        (lambda words: [words[0], "0", "0", "0", "0", *words[5:]], "The pose of image '.*' of "),
        (lambda words: [*words[:9], "IMG 00.png"], "images.txt' has the image 'IMG 00.png' twice"),
    ],
)
def test_images_that_no_model_has(edit, words, model):
    path = model / "sparse" / "0" / "images.txt"
    lines = path.read_text(encoding="utf-8").splitlines()
    images = [number for number, line in enumerate(lines) if line.count(" ") >= 9 and line[0] != "#"]
    lines[images[1]] = " ".join(edit(lines[images[1]].split(" ")))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.raises(UserError, match=words):
        read_capture(model)


def test_widths_of_hundreds_of_digits(model):
    path = model / "sparse" / "0" / "cameras.txt"
    path.write_text(
        path.read_text(encoding="utf-8").replace(" 16 12 ", f" {'9' * 400} 12 ", 1), encoding="utf-8"
    )
    with pytest.raises(UserError, match=r"cameras.txt' is malformed in line"):
        read_capture(model)


def test_of_several_models_the_one_with_most_images(model):
    small = shutil.copytree(model / "sparse" / "0", model / "sparse" / "1")
    (model / "sparse" / "0").rename(model / "sparse" / "2")
    lines = (small / "images.txt").read_text(encoding="utf-8").splitlines()
    short = [line for line in lines if "IMG" in line][:2]
    (small / "images.txt").write_text("\n\n".join(short), encoding="utf-8")
    assert colmap.find(model) == model / "sparse" / "2"
    capture = read_capture(model)
    assert len(capture.frames) == len(CAMERAS)
    assert re.match(r".* has 2 models; '2' is taken", capture.notes[0])
    assert len(read_capture(small, images=model / "images").frames) == 2


def test_names_with_backslashes(model):
    path = model / "sparse" / "0" / "images.txt"
    found = read_capture(model)
    (model / "images" / "inner").mkdir()
    for frame in found.frames:
        frame.image.rename(model / "images" / "inner" / frame.image.name)
    text = path.read_text(encoding="utf-8")
    for frame in found.frames:
        text = text.replace(f" {frame.image.name}\n", f" inner\\{frame.image.name}\n")
    path.write_text(text, encoding="utf-8")
    assert {f.image.parent.name for f in read_capture(model).frames} == {"inner"}


# --- XML of others


def test_xml_that_is_not_mitsubas(tmp_path):
    (tmp_path / "cameras.xml").write_text(
        '<?xml version="1.0"?><document><chunk><sensors><sensor id="0"/></sensors></chunk></document>',
        encoding="utf-8",
    )
    for source in (tmp_path, tmp_path / "cameras.xml"):
        with pytest.raises(UserError, match=r"is no known capture.* Metashape .* export to COLMAP"):
            read_capture(source)


# --- masks


@pytest.mark.parametrize(
    "layout, works", [("{camera}/{name}", True), ("deep/{camera}/{name}", True), ("{name}", False)]
)
def test_masks_of_images_of_one_name(layout, works, nerf):
    """``deep``: images and masks in two levels of folders."""
    inside = "deep/" if layout.startswith("deep") else ""

    def edit(document):
        for k, frame in enumerate(document["frames"]):
            old, new = nerf / frame["file_path"], f"images/{inside}cam{k % 2}/{k // 2}.png"
            (nerf / new).parent.mkdir(parents=True, exist_ok=True)
            mask = nerf / "masks" / layout.format(camera=f"cam{k % 2}", name=f"{k // 2}.png")
            mask.parent.mkdir(parents=True, exist_ok=True)
            rgba = np.array(Image.open(old))
            Image.fromarray(rgba[..., 3]).save(mask)
            Image.fromarray(rgba[..., :3]).save(nerf / new)
            frame["file_path"] = new

    change(nerf, edit)
    capture = read_capture(nerf)
    if not works:
        with pytest.raises(UserError, match="neither the images' names nor their number"):
            assign_masks(capture, None)
        return
    for frame, camera in zip(assign_masks(capture, None).frames, CAMERAS, strict=True):
        assert (frame.mask.parent.name, frame.mask.name) == (frame.image.parent.name, frame.image.name)
        alpha = coverage_of(frame, np.zeros((12, 16, 3), np.uint8))
        np.testing.assert_allclose(alpha, camera.render()[..., 3], atol=0.01)


@pytest.mark.parametrize("larger", [1, 3])
@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_masks_that_were_turned_as_exif_tells(orientation, larger, tmp_path):
    values = np.random.default_rng(0).integers(0, 255, (6, 8), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    stored = Image.fromarray(values.repeat(larger, axis=0).repeat(larger, axis=1))
    stored.getexif()[0x112] = orientation
    ImageOps.exif_transpose(stored).save(tmp_path / "mask.png")
    camera = Camera(8, 6, 8.0, 8.0, 4.0, 3.0, np.eye(4))
    frame = Frame(tmp_path / "a.jpg", camera, tmp_path / "mask.png", ignored=tmp_path / "mask.png")
    found = coverage_of(frame, np.zeros((6, 8, 3), np.uint8))
    np.testing.assert_array_equal(read_ignored(frame, (6, 8), 1), found)
    np.testing.assert_allclose(found, values / 255, atol=1e-6)


@pytest.mark.parametrize("follow", [True, False])
@pytest.mark.parametrize("orientation", [3, 6])
def test_masks_that_were_turned_though_sizes_do_not_tell(orientation, follow, tmp_path):
    """Photographs upside down or square, with masks of a tool that honours their EXIF orientation or not."""
    width = 18 if orientation == 6 else 24
    cameras = known_cameras(8, width=width, height=18, fx=20.0, fy=20.0, cx=width - 5.0, cy=5.5)
    write_colmap(tmp_path / "set", cameras, binary=False)
    model = tmp_path / "set" / "sparse" / "0" / "images.txt"
    model.write_text(model.read_text().replace(".png", ".webp"))
    exif = Image.Exif()
    exif[0x112] = orientation
    images, masks = (sorted((tmp_path / "set" / name).iterdir()) for name in ("images", "masks"))
    for image, mask in zip(images, masks, strict=True):
        Image.open(image).save(image.with_suffix(".webp"), exif=exif, lossless=True)
        stored = Image.open(mask)
        stored.load()
        if follow:
            stored.getexif()[0x112] = orientation
            stored = ImageOps.exif_transpose(stored)
        stored.save(mask.with_name(image.name))
        image.unlink()
        mask.unlink()
    result = import_capture(tmp_path / "set", tmp_path / "a.xml", config=CaptureConfig(resolution=8))
    assert any("the masks are turned back" in warning for warning in result.warnings) == follow
    for target, camera in zip(load_fit_scene(result.path).targets, cameras, strict=True):
        np.testing.assert_allclose(target.rgba[..., 3], camera.render()[..., 3], atol=0.01)


def rescaled_alpha(nerf, level):
    """Gives the alpha of each frame's image another largest value; ``level`` of the frame's number."""
    document = json.loads((nerf / "transforms.json").read_text(encoding="utf-8"))
    for number, frame in enumerate(document["frames"]):
        rgba = np.array(Image.open(nerf / frame["file_path"]))
        rgba[..., 3] = np.round(rgba[..., 3] / 255.0 * level(number))
        Image.fromarray(rgba).save(nerf / frame["file_path"])


def largest_coverage(result):
    """The largest alpha of each training target."""
    return [target.rgba[..., 3].max() for target in load_fit_scene(result.path).targets]


@pytest.mark.parametrize("level", [200, 128, 1])
def test_masks_of_another_white_are_stretched(level, nerf, tmp_path):
    rescaled_alpha(nerf, lambda number: level)
    result = import_capture(nerf, tmp_path / "a.xml", config=CaptureConfig(resolution=8))
    np.testing.assert_allclose(largest_coverage(result), 1, atol=1e-3)
    assert any(f"value in the masks is {level} of 255" in warning for warning in result.warnings)


@pytest.mark.parametrize("inverted", [False, True])
def test_mask_files_of_another_white_are_stretched(inverted, tmp_path):
    values = np.zeros((6, 8), np.uint8)
    values[2:4, 2:6] = 128
    if inverted:
        values = 128 - values
    Image.fromarray(values).save(tmp_path / "mask.png")
    frame = Frame(
        tmp_path / "a.png",
        Camera(8, 6, 8.0, 8.0, 4.0, 3.0, np.eye(4)),
        tmp_path / "mask.png",
        ignored=tmp_path / "mask.png",
    )
    white = white_of([frame] * 3)
    assert white == ignored_white_of([frame]) == pytest.approx(128 / 255)
    found = coverage_of(frame, np.zeros((6, 8, 3), np.uint8), inverted=inverted, white=white)
    expected = np.zeros((6, 8))
    expected[2:4, 2:6] = 1
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(read_ignored(frame, (6, 8), 1, white), abs(expected - inverted), atol=1e-6)


def a_frame(mask):
    return Frame(mask.with_name("a.png"), Camera(8, 6, 8.0, 8.0, 4.0, 3.0, np.eye(4)), mask)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_masks_that_number_parts_cover_them_all(dtype, tmp_path):
    """The first one shows only part 2, and the last one nothing."""
    for number, parts in enumerate(([0, 0, 2, 2], [0, 1, 2, 2], [0, 7, 1, 0], [0, 0, 0, 0])):
        Image.fromarray(np.repeat(np.array([parts] * 6, dtype), 2, axis=1)).save(tmp_path / f"{number}.png")
    frames = [a_frame(tmp_path / f"{number}.png") for number in range(4)]
    white = white_of(frames)
    for frame, parts in zip(frames, ([0, 0, 1, 1], [0, 1, 1, 1], [0, 1, 1, 0], [0] * 4), strict=True):
        found = coverage_of(frame, np.zeros((6, 8, 3), np.uint8), white=white)
        np.testing.assert_allclose(found, np.repeat([parts] * 6, 2, axis=1), atol=1e-6)


@pytest.mark.parametrize("top", [1, 255, 65535])
def test_floating_point_masks_of_the_values_of_integers(top, tmp_path):
    """An outline's grey stays what it is."""
    values = np.repeat(np.array([[0, 0, 0, 0.25, 1, 1, 1, 1]], np.float32), 6, axis=0)
    tifffile.imwrite(tmp_path / "mask.tif", values * np.float32(top))
    frame = a_frame(tmp_path / "mask.tif")
    assert white_of([frame]) == 1
    np.testing.assert_allclose(coverage_of(frame, np.zeros((6, 8, 3), np.uint8)), values, atol=1e-6)


def test_eight_bits_in_sixteen_are_no_numbers_of_parts(tmp_path):
    values = np.array([[0, 12, 255, 255]] * 6, np.uint16)
    Image.fromarray(values).save(tmp_path / "mask.png")
    assert white_of([a_frame(tmp_path / "mask.png")]) == pytest.approx(255 / 65535)


def test_masks_that_disagree_or_are_feathered_are_as_they_are(tmp_path):
    frames = []
    fade = np.round(200 * np.exp(-(((np.arange(64) - 32) / 12.0) ** 2)))
    for name, values in (("full", [0, 255]), ("faint", [0, 200]), ("fainter", [0, 90]), ("feathered", fade)):
        Image.fromarray(np.outer(np.ones(8), values).astype(np.uint8)).save(tmp_path / f"{name}.png")
        frames.append(
            Frame(tmp_path / "a.png", Camera(8, 6, 8.0, 8.0, 4.0, 3.0, np.eye(4)), tmp_path / f"{name}.png")
        )
    full, faint, fainter, feathered = frames
    assert white_of([faint, full]) == white_of([faint, fainter]) == white_of([feathered] * 2) == 1


def test_one_faint_mask_is_told(nerf, tmp_path):
    rescaled_alpha(nerf, lambda number: 191 if number == 0 else 255)
    result = import_capture(nerf, tmp_path / "a.xml", config=CaptureConfig(resolution=8))
    told = [warning for warning in result.warnings if "nowhere" in warning]
    assert told and told[0].startswith("1 mask ") and "frame_00000.png (0.75)" in told[0]
    assert largest_coverage(result)[0] == pytest.approx(191 / 255, abs=1e-3)


# --- cameras


def idr_arrays(folder, edit):
    """Changes the arrays of an IDR capture, written anew; returns its folder."""
    write_idr(folder, CAMERAS)
    with np.load(folder / "cameras_sphere.npz") as stored:
        arrays = dict(stored)
    for index, camera in enumerate(CAMERAS):
        edit(arrays, index, camera)
    np.savez(folder / "cameras_sphere.npz", **arrays)
    return folder


def pose_alone(arrays, index, camera):
    to_camera = np.stack([camera.right, -camera.up, camera.forward])
    arrays[f"world_mat_{index}"] = np.vstack(
        [np.column_stack([to_camera, -to_camera @ camera.origin]), [0, 0, 0, 1]]
    )


def test_poses_with_intrinsics_of_their_own(tmp_path):
    """As in DVR's cameras.npz."""

    def edit(arrays, index, camera):
        pose_alone(arrays, index, camera)
        arrays[f"camera_mat_{index}"] = np.diag(
            [2 * camera.fx / camera.width, 2 * camera.fy / camera.height, 1.0, 1.0]
        )

    capture = read_capture(idr_arrays(tmp_path, edit))
    for frame, camera in zip(capture.frames, CAMERAS, strict=True):
        found = frame.camera
        assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx(
            (camera.fx, camera.fy, camera.cx, camera.cy)
        )
        np.testing.assert_allclose(found.center, camera.origin, atol=1e-9)
        np.testing.assert_allclose(found.forward, camera.forward, atol=1e-9)


def test_poses_without_intrinsics_are_told(tmp_path):
    with pytest.raises(UserError, match=r"camera 0 of .* is a pose without a focal length"):
        read_capture(idr_arrays(tmp_path, pose_alone))


def test_a_unit_sphere_that_nobody_has_fitted(tmp_path):
    """The world is in other units and off the origin, and scale_mat is the identity."""

    def edit(arrays, index, camera):
        moved = np.diag([0.01, 0.01, 0.01, 1.0])
        moved[:3, 3] = [-3, -4, -5]
        arrays[f"world_mat_{index}"] = arrays[f"world_mat_{index}"] @ moved
        arrays[f"scale_mat_{index}"] = np.eye(4)

    folder = idr_arrays(tmp_path / "set", edit)
    result = import_capture(folder, tmp_path / "a.xml", config=CaptureConfig(resolution=8, up="keep"))
    center = (BALL + np.array([3, 4, 5])) * 100
    np.testing.assert_allclose(result.box.mean(axis=0), center, atol=10)
    assert 200 * RADIUS < np.ptp(result.box, axis=0).max() < 300 * RADIUS  # masks are of few pixels


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_a_sphere_that_nobody_can_compute_with_is_none(tmp_path, value):
    def edit(arrays, index, camera):
        arrays[f"scale_mat_{index}"] = np.diag([value, 1, 1, 1])

    assert read_capture(idr_arrays(tmp_path, edit)).region is None


# --- what is written


def test_all_sensors_clip_at_the_same_depths(nerf, tmp_path):
    """Mitsuba compiles each new pair of depths into its kernels."""
    change(nerf, lambda d: d.update(val_filenames=["images/frame_00001.png"]))
    import_capture(nerf, tmp_path / "a.xml", config=CaptureConfig(resolution=8))
    files = [tmp_path / "a" / name for name in ("sensors.xml", "test.xml")]
    text = "".join(path.read_text(encoding="utf-8") for path in files)
    near, far = (set(re.findall(rf'"{name}" value="([^"]*)"', text)) for name in ("near_clip", "far_clip"))
    assert len(near) == len(far) == 1
    near, far = float(near.pop()), float(far.pop())
    distances = [np.linalg.norm(camera.origin - [0.3, -0.2, 0.1]) for camera in CAMERAS]
    assert near < min(distances) - 0.7 and far > max(distances) + 0.7
    assert np.log2(near) % 1 == np.log2(far) % 1 == 0


def test_light_with_infinity_is_refused(nerf, tmp_path):
    radiance = np.ones((8, 16, 3), np.float32)
    radiance[3, 5] = np.inf
    mi.Bitmap(radiance).write(str(tmp_path / "sun.exr"))
    with pytest.raises(UserError, match=r"--light .*sun.exr' holds NaN or infinity .*column 5, row 3"):
        import_capture(nerf, tmp_path / "a.xml", config=CaptureConfig(light=tmp_path / "sun.exr"))
    assert not (tmp_path / "a.xml").exists() and not (tmp_path / "a").exists()


def test_damaged_light_ends_in_a_sentence(nerf, tmp_path, capfd):
    """A Radiance file that writes past the end of Mitsuba's memory."""
    (tmp_path / "sun.hdr").write_bytes(
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 8\n\2\2\0\10" + b"\x88\x80" * 4 + b"\x90\x10" * 40
    )
    assert main([str(nerf), "-o", str(tmp_path / "a.xml"), "--light", str(tmp_path / "sun.hdr")]) == 2
    assert "cannot be read as an image (a scanline is damaged)" in " ".join(capfd.readouterr().err.split())
    assert not (tmp_path / "a.xml").exists()


def test_light_is_copied_in_a_kind_that_is_safe(nerf, tmp_path):
    radiance = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    mi.Bitmap(radiance).write(str(tmp_path / "sun.hdr"))
    import_capture(nerf, tmp_path / "a.xml", config=CaptureConfig(light=tmp_path / "sun.hdr"))
    np.testing.assert_array_equal(
        np.array(mi.Bitmap(str(tmp_path / "a" / "light.exr"))), np.array(mi.Bitmap(str(tmp_path / "sun.hdr")))
    )
    assert 'value="a/light.exr"' in (tmp_path / "a.xml").read_text(encoding="utf-8")
