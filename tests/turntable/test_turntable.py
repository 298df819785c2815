"""Turntables: what is seen from where, in which colours, and the files."""

import re

import imageio_ffmpeg
import mitsuba as mi
import numpy as np
import pytest
from fitted import color_at, open_sphere, write_fit
from PIL import Image

from gshell_mi import UserError
from gshell_mi.export.stock_scene import up_axis
from gshell_mi.images import srgb
from gshell_mi.turntable import TurntableConfig, render_turntable, write_video
from gshell_mi.turntable.__main__ import main
from gshell_mi.turntable.looks import ORANGE, denoiser_available
from gshell_mi.turntable.turntable import orbit

SIZE = 64


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    parent = tmp_path_factory.mktemp("fits")
    (parent / "fit.mp4").mkdir()
    (parent / "fit").mkdir()
    return write_fit(parent / "fit", open_sphere(3))


def frame(folder, **settings) -> np.ndarray:
    envmap = settings.pop("envmap", None)
    config = TurntableConfig(**{"size": SIZE, "frames": 3, "spp": 16, "denoise": False} | settings)
    return next(render_turntable(folder, config, envmap=envmap))


def test_even_light_shows_the_albedo_times_what_reaches_it(folder):
    """Under radiance 1 a closed white diffuse body would be white; grey 1/2 outside of the bowl is 1/2."""
    image = frame(folder, channel="geometry", elevation=0.0, spp=64)
    assert image[SIZE // 2 + 6, SIZE // 2] == pytest.approx(srgb(np.full(3, 0.5)), abs=0.03)
    assert image[0, 0] == pytest.approx(1), "in front of white"


def test_channels(folder):
    normal = frame(folder, channel="normal", elevation=0.0)[SIZE // 2 + 4, SIZE // 2]
    base = frame(folder, channel="base_color", elevation=0.0)[SIZE // 2 + 4, SIZE // 2]
    rough, metal = (frame(folder, channel=name)[40, SIZE // 2] for name in ("roughness", "metallic"))
    assert rough == pytest.approx(srgb(np.full(3, 0.3)), abs=0.01)
    assert metal == pytest.approx(srgb(np.full(3, 0.1)), abs=0.01)
    # The point near the image's centre is where the first camera looks from: towards the normal there.
    linear = np.where(normal <= 0.04045, normal / 12.92, ((normal + 0.055) / 1.055) ** 2.4)
    point = 0.6 * (2 * linear - 1)
    assert base == pytest.approx(srgb(color_at(point)), abs=0.02)


def is_orange(image) -> np.ndarray:
    return (np.abs(image - srgb(np.array(ORANGE))) < 0.02).all(-1)


def test_orange_back_faces_only_inside(folder):
    plain, orange = (
        frame(folder, channel="roughness", elevation=60.0, orange_back=back) for back in (False, True)
    )
    assert is_orange(plain).sum() == 0 and is_orange(orange).sum() > 0.05 * SIZE**2
    from_below = frame(folder, channel="roughness", elevation=-80.0, orange_back=True)
    assert is_orange(from_below).sum() == 0


def test_wires_are_dark_and_thin(folder):
    plain, wires = (frame(folder, channel="base_color", wireframe=wire) for wire in (False, True))
    darker = (plain - wires).mean(-1)
    assert darker.min() > -1e-3 and 0.02 < darker[20:44, 20:44].mean() < 0.5


def test_relit(folder, tmp_path):
    mi.Bitmap(np.full((8, 16, 3), [0.5, 0, 0], np.float32)).write(str(tmp_path / "red.exr"))
    image = frame(folder, envmap=tmp_path / "red.exr", channel="geometry", elevation=0.0)
    middle = image[SIZE // 2 + 6, SIZE // 2]
    assert middle[0] == pytest.approx(srgb(np.array(0.25)), abs=0.03) and middle[1:].max() < 0.01


@pytest.mark.skipif(not denoiser_available(), reason="mitsuba-oidn is not installed: nothing is denoised")
def test_denoised(folder):
    settings = {"channel": "geometry", "elevation": 0.0, "spp": 4}
    noisy, clean = (frame(folder, denoise=on, **settings) for on in (False, True))
    patch = np.s_[34:46, 24:40]
    assert clean[patch].std() < 0.5 * noisy[patch].std()
    assert clean[patch].mean() == pytest.approx(noisy[patch].mean(), abs=0.03)


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1)])
def test_camera_keeps_the_fits_up_axis(up, tmp_path):
    folder = write_fit(tmp_path, open_sphere(2), up=up)
    axis = up_axis(mi.load_file(str(folder / "scene.xml")).sensors())
    sensors = list(orbit(open_sphere(2).vertices, axis, 4, 25.0, 16))
    assert up_axis(sensors) == axis
    origins = np.array([np.array(mi.traverse(s)["to_world"].matrix).reshape(4, 4)[:3, 3] for s in sensors])
    assert np.ptp(origins @ np.array(up)) < 1e-5, "one height"
    center = origins.mean(0) * (1 - np.array(up))
    assert np.ptp(np.linalg.norm((origins - center) * (1 - np.array(up)), axis=1)) < 1e-4, "a circle"


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_objects_of_any_size_are_seen(scale):
    vertices = scale * open_sphere(2).vertices
    for sensor in orbit(vertices, 1, 3, 25.0, 16):
        origin = np.array(mi.traverse(sensor)["to_world"].matrix).reshape(4, 4)[:3, 3]
        distances = np.linalg.norm(vertices - origin, axis=1)
        assert sensor.near_clip() < distances.min() and distances.max() < sensor.far_clip()


@pytest.mark.parametrize(
    "cut, words", [("sensor", "has no sensors"), ("emitter", "has no light"), ("shape", "has no shape")]
)
def test_scenes_that_no_fit_wrote(cut, words, tmp_path):
    folder = write_fit(tmp_path, open_sphere(1), views=1, size=8)
    text = (folder / "scene.xml").read_text(encoding="utf-8")
    text = re.sub(rf"<{cut} .*</{cut}>", "", text, flags=re.DOTALL)
    (folder / "scene.xml").write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=words):
        render_turntable(folder)


def test_video_and_gif(tmp_path):
    ramp = [np.full((32, 48, 3), level) for level in np.linspace(0, 1, 5)]
    video, animation = write_video(iter(ramp), tmp_path / "a" / "turn.mp4", 10.0)
    reader = imageio_ffmpeg.read_frames(str(video))
    meta = next(reader)
    frames = [np.frombuffer(data, np.uint8) for data in reader]
    assert meta["size"] == (48, 32) and meta["fps"] == 10 and len(frames) == 5
    np.testing.assert_allclose([f.mean() / 255 for f in frames], np.linspace(0, 1, 5), atol=0.03)
    with Image.open(animation) as gif:
        assert gif.n_frames == 5 and gif.info["duration"] == 100 and gif.info["loop"] == 0


def films(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    "name",
    ["-dash.mp4", "concat:a|b.mp4", "pipe:1.mp4", "tcp:127.0.0.1:9.mp4", "a b;c.mp4", "%d.mp4", "$(x).mp4"],
)
def test_any_name_is_a_files(folder, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    options = ["--frames", "2", "--size", "32", "--spp", "1", "--quiet"]
    assert main([str(folder), f"--output={name}", *options]) == 0
    assert set(films(tmp_path)) == {name, name.removesuffix("mp4") + "gif"}
    assert imageio_ffmpeg.count_frames_and_secs(f"file:{tmp_path / name}")[0] == 2


def test_a_film_is_replaced_by_a_film_alone(tmp_path):
    frames = [np.zeros((32, 32, 3))] * 3
    for _ in range(2):
        write_video(iter(frames), tmp_path / "turn.mp4", 10.0)
    for name in ("turn.mp4", "turn.gif"):
        (tmp_path / name).write_bytes(b"holiday")
        before = films(tmp_path)
        with pytest.raises(UserError, match=f"{name}' exists and was not written by gshell_mi"):
            write_video(iter(frames), tmp_path / "turn.mp4", 10.0)
        assert films(tmp_path) == before
        (tmp_path / name).unlink()


def test_ffmpeg_that_fails(tmp_path, monkeypatch):
    """Whenever it does: at once, at the end, or as if nothing had been."""
    frames = [np.zeros((32, 32, 3))] * 3
    write_video(iter(frames), tmp_path / "turn.mp4", 10.0)
    before = films(tmp_path)
    for script in ("echo 'x: Disk on fire' >&2; exit 1", "cat >/dev/null; echo 'Disk on fire' >&2; exit 3"):
        ffmpeg = tmp_path.parent / "ffmpeg"
        ffmpeg.write_text(f"#!/bin/sh\n{script}\n")
        ffmpeg.chmod(0o755)
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(ffmpeg))
        with pytest.raises(UserError, match=r"turn.mp4' cannot be written \(ffmpeg: Disk on fire\)"):
            write_video(iter(frames * 100), tmp_path / "turn.mp4", 10.0)
        assert films(tmp_path) == before
    ffmpeg.write_text("#!/bin/sh\ncat >/dev/null\n")
    with pytest.raises(UserError, match="ffmpeg: no reason given"):
        write_video(iter(frames), tmp_path / "turn.mp4", 10.0)
    assert films(tmp_path) == before


def test_a_full_disk_leaves_the_earlier_film(tmp_path):
    resource = pytest.importorskip("resource")
    noise = np.random.default_rng(0).random((4, 64, 64, 3))
    write_video(iter(noise[:1]), tmp_path / "turn.mp4", 10.0)
    before, limits = films(tmp_path), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8000, limits[1]))
    try:
        with pytest.raises(UserError, match=r"turn.mp4' cannot be written \("):
            write_video(iter(noise), tmp_path / "turn.mp4", 10.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert films(tmp_path) == before


def test_interrupted(tmp_path):
    def frames():
        yield np.zeros((32, 32, 3))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(frames(), tmp_path / "turn.mp4", 10.0)
    assert films(tmp_path) == {}


def test_command(folder, tmp_path, capsys):
    out = tmp_path / "turn.mp4"
    assert main([str(folder), "-o", str(out), "--frames", "2", "--size", "32", "--spp", "1", "--quiet"]) == 0
    assert out.is_file() and out.with_suffix(".gif").is_file()
    assert str(out) in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("{none}",), "holds no fit (scene.xml is missing)"),
        (("{fit}", "--frames", "0"), "--frames must be at least 1"),
        (("{fit}", "--size", "33"), "--size must be even"),
        (("{fit}", "--fps", "0"), "--fps lies between"),
        (("{fit}", "--size", "1000000"), "GiB are free; lower its size or its samples per pixel"),
        (("{fit}", "--spp", "1000000000"), "GiB are free; lower its size or its samples per pixel"),
        (
            ("{fit}", "--max-depth", "1000000000000"),
            "--max-depth must be at least 2 (direct light) and at most",
        ),
        (("{fit}", "--elevation", "90"), "--elevation lies between"),
        (("{fit}", "--max-depth", "1"), "--max-depth must be at least 2"),
        (("{fit}", "--channel", "albedo"), "--channel 'albedo' is unknown; choose one of shaded"),
        (("{fit}", "--envmap", "{none}"), "does not exist; check the path"),
        (("{fit}", "--envmap", "{fit}/scene.xml"), "cannot be read"),
        (
            ("{fit}", "-o", "..", "--frames", "1", "--size", "16"),
            "is no name; give one such as turntable.mp4",
        ),
        (("{fit}", "-o", "/", "--frames", "1", "--size", "16"), "is no name; give one such as turntable.mp4"),
        (("{fit}", "-o", "x" * 300, "--frames", "1", "--size", "16"), "is longer than 200 bytes"),
        (("{fit}", "-o", "{fit}", "--frames", "1", "--size", "16"), "fit.mp4' exists and was not written by"),
        (("{fit}", "-o", "{fit}/mesh.ply/turn.mp4", "--frames", "1", "--size", "16"), "cannot be written"),
    ],
)
def test_mistakes(folder, tmp_path, capsys, arguments, message):
    places = {"none": tmp_path / "none", "fit": folder}
    assert main([argument.format(**places) for argument in arguments] + ["--quiet"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1


def test_a_film_that_would_be_none(tmp_path):
    """Nothing is written beside it."""
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match=r"would be an MP4; give a name that ends in \.mp4"):
        write_video([], tmp_path / "notes.txt", 12)
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]
