"""Videos to frames."""

from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from gshell_mi.capture import video
from gshell_mi.capture.workspace import Workspace
from gshell_mi.errors import UserError


def test_frames_are_spread_by_what_changes():
    """A camera that rests for half of the video gets no half of the frames."""
    change = np.concatenate([np.ones(50), np.zeros(50)])
    chosen = video.choose(np.ones(100), change, 10)
    assert len(chosen) == 10 and (chosen < 50).sum() >= 9
    assert np.diff(chosen[chosen < 50]).max() <= 11


def test_each_is_the_sharpest_of_its_stretch():
    sharpness = np.tile([1.0, 3.0, 2.0], 10)
    np.testing.assert_array_equal(video.choose(sharpness, np.ones(30), 10), np.arange(1, 30, 3))


def test_a_short_video_gives_what_it_has():
    np.testing.assert_array_equal(video.choose(np.ones(4), np.ones(4), 80), np.arange(4))


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Twelve frames of a pattern that moves; every third frame is sharp."""
    path = tmp_path_factory.mktemp("clip") / "a clip, Möbel.mp4"
    rng = np.random.default_rng(0)
    pattern = np.clip(ndimage.gaussian_filter(rng.standard_normal((64, 128)), 1.5) * 150 + 128, 0, 255)
    writer = imageio_ffmpeg.write_frames(
        str(path), (64, 64), fps=12, codec="libx264", quality=9, macro_block_size=16
    )
    writer.send(None)
    frames = []
    for index in range(12):
        frame = pattern[:, 4 * index : 4 * index + 64]
        if index % 3 != 1:
            frame = ndimage.gaussian_filter(frame, 3)
        frames.append(np.repeat(frame.astype(np.uint8)[..., None], 3, axis=-1))
        writer.send(frames[-1].tobytes())
    writer.close()
    return path, frames


def test_a_video_is_cut_once(clip, tmp_path, monkeypatch):
    path, frames = clip
    files = video.cut(path, Workspace(tmp_path / "s.work"), 4)
    assert [file.name for file in files] == [f"frame_{index:06}.png" for index in (1, 4, 7, 10)]
    difference = np.array(Image.open(files[1])).astype(int) - frames[4]
    assert np.abs(difference).mean() < 6
    monkeypatch.setattr(video, "_judge", None)
    assert video.cut(path, Workspace(tmp_path / "s.work"), 4) == files


@pytest.mark.parametrize("name", ["-dash.mp4", "concat:a|b.mp4", "pipe:0.mp4", "%d.mp4"])
def test_any_name_is_a_files(clip, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_bytes(clip[0].read_bytes())
    assert len(video.cut(Path(name), Workspace(Path("s.work")), 4)) == 4


def test_a_playlist_is_no_video(clip, tmp_path):
    (tmp_path / "clip.mp4").write_bytes(clip[0].read_bytes())
    (tmp_path / "v.mp4").write_text("ffconcat version 1.0\nfile 'clip.mp4'\n")
    with pytest.raises(UserError, match=r"v\.mp4' cannot be read"):
        video.cut(tmp_path / "v.mp4", Workspace(tmp_path / "s.work"), 4)


def test_what_is_no_video_is_told(clip, tmp_path):
    (tmp_path / "v.mp4").write_bytes(clip[0].read_bytes()[:200])
    with pytest.raises(UserError, match=r"v\.mp4' cannot be read"):
        video.cut(tmp_path / "v.mp4", Workspace(tmp_path / "s.work"), 4)
    assert video.is_video(tmp_path / "v.mp4") and not video.is_video(tmp_path / "none.mp4")


@pytest.mark.parametrize("transfer, words", [("arib-std-b67", "HLG"), ("smpte2084", "PQ"), ("bt709", None)])
def test_films_of_high_dynamic_range_are_told(transfer, words, tmp_path):
    path = tmp_path / "v.mp4"
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (64, 64),
        codec="libx264",
        pix_fmt_out="yuv420p10le",
        output_params=["-vf", f"setparams=color_primaries=bt2020:color_trc={transfer}:colorspace=bt2020nc"],
    )
    writer.send(None)
    for _ in range(4):
        writer.send(bytes(64 * 64 * 3))
    writer.close()
    found = video.notes(path)
    assert [words in note for note in found] == ([True] if words else [])
