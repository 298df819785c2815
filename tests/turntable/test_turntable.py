"""Turntables: what is seen from where, in which colours, and the files."""

import re
from pathlib import Path

import imageio_ffmpeg
import mitsuba as mi
import numpy as np
import pytest
from fitted import color_at, open_sphere, write_fit
from PIL import Image

from gshell_mi.errors import UserError
from gshell_mi.export.stock_scene import up_axis
from gshell_mi.images import srgb
from gshell_mi.turntable import TurntableConfig, render_turntable, write_video
from gshell_mi.turntable.__main__ import main
from gshell_mi.turntable.looks import ORANGE, denoiser_available
from gshell_mi.turntable.turntable import orbit

SIZE = 64


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_fit(tmp_path_factory.mktemp("fit"), open_sphere(3))


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
    plain, orange = (frame(folder, channel="roughness", elevation=60.0, orange_back=back)
                     for back in (False, True))
    assert is_orange(plain).sum() == 0 and is_orange(orange).sum() > 0.05 * SIZE ** 2
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


@pytest.mark.parametrize("name", ["..", "", "x" * 300])
def test_films_that_are_no_files(name):
    with pytest.raises(UserError, match=r"is no file name|has a name of 300 bytes"):
        write_video(iter([]), Path(name), 10.0)


@pytest.mark.parametrize("cut, words", [("sensor", "has no sensors"), ("emitter", "has no light"),
                                        ("shape", "has no shape")])
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


def test_command(folder, tmp_path, capsys):
    out = tmp_path / "turn.mp4"
    assert main([str(folder), "-o", str(out), "--frames", "2", "--size", "32", "--spp", "1", "--quiet"]) == 0
    assert out.is_file() and out.with_suffix(".gif").is_file()
    assert str(out) in capsys.readouterr().out


@pytest.mark.parametrize("arguments, message", [
    (("{none}",), "holds no fit (scene.xml is missing)"),
    (("{fit}", "--frames", "0"), "--frames must be at least 1"),
    (("{fit}", "--size", "33"), "--size must be even"),
    (("{fit}", "--fps", "0"), "--fps lies between"),
    (("{fit}", "--elevation", "90"), "--elevation lies between"),
    (("{fit}", "--max-depth", "1"), "--max-depth must be at least 2"),
    (("{fit}", "--channel", "albedo"), "--channel 'albedo' is unknown; choose one of shaded"),
    (("{fit}", "--envmap", "{none}"), "does not exist; check the path"),
    (("{fit}", "--envmap", "{fit}/scene.xml"), "cannot be read"),
    (("{fit}", "-o", "{fit}/mesh.ply/turn.mp4", "--frames", "1", "--size", "16"), "cannot be written"),
])
def test_mistakes(folder, tmp_path, capsys, arguments, message):
    places = {"none": tmp_path / "none", "fit": folder}
    assert main([argument.format(**places) for argument in arguments] + ["--quiet"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1
