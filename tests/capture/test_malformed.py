"""Malformed captures and mistaken options: exit code 2, one sentence, nothing written."""

import json
import shutil
import struct
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from known_capture import known_cameras, write_colmap, write_idr, write_llff, write_mitsuba, write_nerf
from PIL import Image

from gshell_mi.capture.__main__ import main

FEW = known_cameras(4, width=24, height=18, fx=28, fy=28, cx=12, cy=9)
WRITERS = {
    "nerf": write_nerf,
    "colmap": write_colmap,
    "idr": write_idr,
    "llff": write_llff,
    "mitsuba": write_mitsuba,
    "colmap text": lambda f, c: write_colmap(f, c, binary=False),
}


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("originals")
    for name, write in WRITERS.items():
        (folder / name).mkdir()
        write(folder / name, FEW)
    return folder


def cut(name, share=0.6):
    def spoil(folder):
        path = folder / name
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])

    return spoil


def write(name, content):
    def spoil(folder):
        (folder / name).write_bytes(content)

    return spoil


def remove(name):
    def spoil(folder):
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return spoil


def image(name, make, mode=None):
    def spoil(folder):
        make(Image.open(folder / name).convert(mode or "RGBA")).save(folder / name)

    return spoil


def transforms(change):
    """Changes the parsed transforms_train.json in place, or replaces it by what ``change`` returns."""

    def spoil(folder):
        path = folder / "transforms_train.json"
        document = json.loads(path.read_text())
        changed = change(document)
        path.write_text(json.dumps(document if changed is None else changed))

    return spoil


def pose(make):
    return transforms(
        lambda d: d["frames"][1].update(transform_matrix=make(np.array(d["frames"][1]["transform_matrix"])))
    )


def frame(**values):
    return transforms(lambda d: d["frames"][1].update(values))


def text(name, old, new):
    def spoil(folder):
        path = folder / name
        before = path.read_text()
        assert old in before
        path.write_text(before.replace(old, new, 1))

    return spoil


def arrays(change):
    def spoil(folder):
        path = folder / "cameras_sphere.npz"
        stored = dict(np.load(path))
        change(stored)
        np.savez(path, **stored)

    return spoil


def poses_bounds(change):
    def spoil(folder):
        np.save(folder / "poses_bounds.npy", change(np.load(folder / "poses_bounds.npy")))

    return spoil


def exr_with_nan(folder):
    pixels = np.array(mi.Bitmap(str(folder / "shot_1.exr")))
    pixels[3, 5] = np.nan
    mi.Bitmap(pixels).write(str(folder / "shot_1.exr"))


def deep_png_cut_off(folder):
    path = folder / "train/r_1.png"
    mi.Bitmap(np.array(Image.open(path)).astype(np.uint16) * 257).write(str(path))
    cut("train/r_1.png")(folder)


def all_poses(change):
    def spoil(document):
        for entry in document["frames"]:
            entry["transform_matrix"] = change(np.array(entry["transform_matrix"])).tolist()

    return transforms(spoil)


def nothing(folder):
    pass


def fisheye(folder):
    path = folder / "sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<i", data, 12, 5)
    path.write_bytes(data)


FLIP = np.diag([1.0, -1, -1, 1])
PNG, JSON = "train/r_1.png", "transforms_train.json"

#: What is done: format, what spoils it, options, words of the message.
CASES = {
    "PNG cut off": ("nerf", cut(PNG), [], "r_1.png' cannot be read"),
    "PNG is text": ("nerf", write(PNG, b"not an image"), [], "r_1.png' cannot be read"),
    "PNG is empty": ("nerf", write(PNG, b""), [], "r_1.png' cannot be read"),
    "EXR cut off": ("mitsuba", cut("shot_1.exr"), [], "shot_1.exr' cannot be read"),
    "EXR header only": ("mitsuba", cut("shot_1.exr", 0.1), [], "shot_1.exr' cannot be read"),
    "EXR with NaN": ("mitsuba", exr_with_nan, [], "column 5, row 3"),
    "image missing": ("nerf", remove(PNG), [], "is missing"),
    "image folder missing": ("llff", remove("images"), [], "no folder 'images'"),
    "not JSON": ("nerf", cut(JSON), [], "is no JSON file"),
    "not UTF-8": ("nerf", write(JSON, b"\xff\xfe\x00{}"), [], "is no JSON file"),
    "JSON is a list": ("nerf", transforms(lambda d: d["frames"]), [], "JSON list"),
    "no frames": ("nerf", transforms(lambda d: d.update(frames=[])), [], "no list of frames"),
    "frames is an object": ("nerf", transforms(lambda d: d.update(frames={"0": 1})), [], "no list of frames"),
    "frame is a string": ("nerf", transforms(lambda d: d["frames"].insert(1, "r_1")), [], "Frame 1"),
    "file_path is a number": ("nerf", frame(file_path=7), [], "not a file's name"),
    "pose with NaN": ("nerf", pose(lambda m: (m * np.nan).tolist()), [], "holds NaN"),
    "pose of strings": ("nerf", pose(lambda m: "identity"), [], "not a 4 x 4 matrix"),
    "pose missing": ("nerf", frame(transform_matrix=None), [], "not a 4 x 4 matrix"),
    "pose of 3 x 3": ("nerf", pose(lambda m: m[:3, :3].tolist()), [], "not a 4 x 4 matrix"),
    "pose ragged": ("nerf", pose(lambda m: [[1, 0, 0], [0, 1]]), [], "not a 4 x 4 matrix"),
    "pose mirrored": ("nerf", pose(lambda m: (m @ np.diag([-1, 1, 1, 1])).tolist()), [], "is mirrored"),
    "pose sheared": ("nerf", pose(lambda m: (m @ np.diag([1, 2, 1, 1])).tolist()), [], "is no rotation"),
    "pose of zeros": ("nerf", pose(lambda m: (0 * m).tolist()), [], "is singular"),
    "pose absurdly far": (
        "nerf",
        pose(lambda m: (m + np.eye(4)[:, :1] * [0, 0, 0, 1e30]).tolist()),
        [],
        "too large",
    ),
    "centre absurdly far": ("nerf", frame(cx=1e30), [], "impossible intrinsics"),
    "width of 0": ("llff", poses_bounds(lambda p: p * (np.arange(17) != 9)), [], "impossible intrinsics"),
    "pose transposed": ("nerf", pose(lambda m: m.T.tolist()), [], "row 0 0 0 1"),
    "axes flipped": ("nerf", all_poses(lambda m: m @ FLIP), [], "--opencv-axes"),
    "poses inverted": ("nerf", all_poses(np.linalg.inv), [], "world-to-camera"),
    "focal length a string": ("nerf", frame(fl_x="700"), [], "'fl_x' of frame 1"),
    "focal length negative": ("nerf", frame(fl_x=-3.0), [], "must be positive"),
    "no focal length": ("nerf", transforms(lambda d: d.update(camera_angle_x=None)), [], "no focal length"),
    "angle in degrees": ("nerf", transforms(lambda d: d.update(camera_angle_x=42.0)), [], "in radians"),
    "fisheye lens": ("nerf", frame(camera_model="OPENCV_FISHEYE"), [], "OPENCV_FISHEYE"),
    "declared for another aspect": ("nerf", frame(w=30, h=30), [], "declared for 30 x 30"),
    "image turned": ("nerf", frame(w=18, h=24), [], "EXIF orientation"),
    "no alpha": ("nerf", image(PNG, lambda i: i.convert("RGB")), [], "has no alpha"),
    "opaque alpha": ("nerf", image(PNG, lambda i: i.convert("RGB").convert("RGBA")), [], "alpha of 1"),
    "16-bit PNG cut off": ("nerf", deep_png_cut_off, [], "r_1.png' cannot be read"),
    "mask folder missing": ("nerf", nothing, ["--masks", "nowhere"], "--masks"),
    "a mask missing": ("colmap", remove("masks/IMG 02.png.png"), [], "IMG 02.png' has no mask"),
    "no masks": ("colmap", remove("masks"), ["--make-masks", "off"], "supply images with alpha"),
    "unknown maker of masks": ("nerf", nothing, ["--make-masks", "magic"], "choose grabcut, rembg or off"),
    "too few frames of a video": ("nerf", nothing, ["--frames", "1"], "--frames"),
    "ignore folder missing": ("nerf", nothing, ["--ignore", "nowhere"], "correct --ignore"),
    "ignore masks of other names": ("nerf", nothing, ["--ignore", "{source}"], "named like an image"),
    "LLFF without masks": ("llff", image("images/image001.png", lambda i: i.convert("RGB")), [], "--masks"),
    "mask of another size": ("idr", image("mask/002.png", lambda i: i.resize((9, 9)), "L"), [], "9 x 9"),
    "mask is text": ("idr", write("mask/001.png", b"white"), [], "001.png' cannot be read"),
    "masks of other names and number": ("idr", remove("mask/002.png"), [], "3 masks, 4 images"),
    "masks inverted to nothing": (
        "nerf",
        nothing,
        ["--background", "white", "--background-tolerance", "99"],
        "are empty",
    ),
    "COLMAP cameras cut off": ("colmap", cut("sparse/0/cameras.bin"), [], "cameras.bin' ends before"),
    "COLMAP images cut off": ("colmap", cut("sparse/0/images.bin"), [], "images.bin' ends before"),
    "COLMAP fisheye": ("colmap", fisheye, [], "OPENCV_FISHEYE"),
    "COLMAP unknown model": ("colmap text", text("sparse/0/cameras.txt", "PINHOLE", "FOV"), [], "model FOV"),
    "COLMAP bad line": ("colmap text", text("sparse/0/images.txt", "7 ", "7 x "), [], "malformed in line 2"),
    "COLMAP parameter missing": ("colmap text", text("sparse/0/cameras.txt", " 28.0", ""), [], "in line 2"),
    "COLMAP no such camera": ("colmap text", text("sparse/0/cameras.txt", "100 ", "1000 "), [], "camera 100"),
    "COLMAP no images": ("colmap", write("sparse/0/images.bin", struct.pack("<Q", 0)), [], "has no images"),
    "COLMAP image missing": ("colmap", remove("images/IMG 01.png"), [], "IMG 01.png' is missing"),
    "IDR image missing": ("idr", remove("image/000001.png"), [], "4 cameras"),
    "IDR cut off": ("idr", cut("cameras_sphere.npz"), [], "cannot be read"),
    "IDR other arrays": ("idr", lambda f: np.savez(f / "cameras_sphere.npz", x=1), [], "no world_mat_0"),
    "IDR matrix of NaN": (
        "idr",
        arrays(lambda a: a.update(world_mat_1=np.full((4, 4), np.nan))),
        [],
        "camera 1 of",
    ),
    "IDR singular": ("idr", arrays(lambda a: a.update(world_mat_1=np.zeros((4, 4)))), [], "is singular"),
    "LLFF of another shape": ("llff", poses_bounds(lambda p: p[:, :15]), [], "(4, 15)"),
    "LLFF too few poses": ("llff", poses_bounds(lambda p: p[:3]), [], "3 poses"),
    "LLFF with NaN": ("llff", poses_bounds(lambda p: p * np.nan), [], "NaN"),
    "LLFF of objects": ("llff", poses_bounds(lambda p: np.array([{}])), [], "cannot be read"),
    "XML cut off": ("mitsuba", cut("sensors.xml"), [], "cannot be loaded by Mitsuba"),
    "XML not UTF-8": (
        "mitsuba",
        lambda f: write("sensors.xml", (f / "sensors.xml").read_bytes().replace(b"shot_1", b"shot\xff1"))(f),
        [],
        "cannot be loaded by Mitsuba",
    ),
    "XML film of another size": ("mitsuba", text("sensors.xml", 'value="24"', 'value="25"'), [], "25 x 18"),
    "XML without sensors": (
        "mitsuba",
        write("sensors.xml", b"<scene version='3.0.0'/><!--<sensor-->"),
        [],
        "has no sensors",
    ),
    "empty folder": ("nerf", lambda f: [remove(JSON)(f), remove("train")(f)], [], "no known capture"),
    "two JSON files, neither the usual": (
        "nerf",
        lambda f: [
            shutil.copy(f / JSON, f / "transforms_a.json"),
            (f / JSON).rename(f / "transforms_b.json"),
        ],
        [],
        "transforms_a",
    ),
    "box of no size": ("nerf", nothing, ["--box", "0", "0", "0", "1", "1", "0"], "is empty"),
    "box of NaN": ("nerf", nothing, ["--box", "nan", "0", "0", "1", "1", "1"], "NaN"),
    "unknown format": ("nerf", nothing, ["--format", "lego"], "--format"),
    "another format": ("nerf", nothing, ["--format", "llff"], "no capture of the format llff"),
    "unknown colour space": ("nerf", nothing, ["--color-space", "sRBG"], "is 'sRGB'"),
    "unknown transfer function": ("nerf", nothing, ["--transfer", "Gamma 2.3"], "is 'Gamma 2."),
    "unknown background": ("nerf", nothing, ["--background", "blurple"], "blurple"),
    "background and masks": ("idr", nothing, ["--background", "white", "--masks", "mask"], "choose one"),
    "unknown up": ("nerf", nothing, ["--up", "w"], "--up"),
    "size below zero": ("nerf", nothing, ["--max-size", "-1"], "--max-size"),
    "hold out all": ("nerf", nothing, ["--hold-out", "1"], "--hold-out"),
    "resolution too low": ("nerf", nothing, ["--resolution", "2"], "--resolution"),
    "resolution too high": ("nerf", nothing, ["--resolution", "1000000"], "--resolution must be from 4"),
    "no tolerance": ("nerf", nothing, ["--background-tolerance", "nan"], "--background-tolerance must"),
    "light missing": ("nerf", nothing, ["--light", "no.exr"], "--light"),
    "light no image": ("nerf", nothing, ["--light", "{source}/transforms_train.json"], "environment map"),
    "exposures no table": ("nerf", nothing, ["--exposures", "{source}/train/r_0.png"], "--exposures"),
    "exposures incomplete": (
        "nerf",
        write("e.json", b'{"r_0.png": 0}'),
        ["--exposures", "{source}/e.json"],
        "'r_1.png'",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_malformed_capture(case, originals, tmp_path, capfd, variant):
    kind, spoil, options, words = CASES[case]
    source, out = tmp_path / "Möbel, 2. Versuch" / "source", tmp_path / "out put"
    shutil.copytree(originals / kind, source)
    spoil(source)
    out.mkdir()
    options = [option.replace("{source}", str(source)) for option in options]
    _fails([str(source), "-o", str(out / "s.xml"), *options, "--quiet", "--variant", variant], words, capfd)
    assert list(out.iterdir()) == []


def _fails(arguments, words, capfd):
    capfd.readouterr()
    assert main(arguments) == 2
    message = capfd.readouterr().err.strip()
    assert message.startswith("error: ") and message.endswith(".") and "\n" not in message
    assert words in message


def test_mistaken_outputs(originals, tmp_path, capfd, variant):
    source = tmp_path / "set"
    shutil.copytree(originals / "nerf", source)
    end = ["--quiet", "--variant", variant]
    _fails([str(source), "-o", str(tmp_path / "set.xml"), *end], "where the capture is", capfd)
    _fails([str(source), "-o", str(tmp_path / "scene"), *end], "must end in .xml", capfd)
    _fails([str(source / "none"), "-o", str(tmp_path / "scene.xml"), *end], "does not exist", capfd)
    _fails([str(source), *end], "-o", capfd)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious.txt").write_text("keep")
    _fails([str(source), "-o", str(tmp_path / "mine.xml"), *end], "exists; replace", capfd)
    _fails([str(source), "-o", str(tmp_path / "mine.xml"), "--overwrite", *end], "leaves it alone", capfd)
    _fails([str(source), "-o", str(source / JSON / "scene.xml"), *end], "cannot be written", capfd)
    assert (tmp_path / "mine" / "precious.txt").read_text() == "keep"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "set"]


def test_failed_import_keeps_the_earlier_scene(originals, tmp_path, capfd, variant):
    source, scene = tmp_path / "set", tmp_path / "scene.xml"
    shutil.copytree(originals / "nerf", source)
    arguments = [str(source), "-o", str(scene), "--quiet", "--variant", variant]
    assert main(arguments) == 0
    _fails(arguments, "exists; replace", capfd)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    cut("train/r_3.png")(source)
    _fails([*arguments, "--overwrite"], "cannot be read", capfd)
    after = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert {p: b for p, b in before.items() if p.name != "r_3.png"} == {
        p: b for p, b in after.items() if p.name != "r_3.png"
    }
    write_nerf(source, FEW[:3])
    assert main([*arguments, "--overwrite"]) == 0
    assert not (tmp_path / "scene" / "view_003.exr").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene", "scene.xml", "set"]
