"""Masks made where there are none."""

import os
import sys
from dataclasses import replace

import mitsuba as mi
import numpy as np
import photographed
import pytest
import tifffile
from known_capture import known_cameras, write_nerf
from PIL import Image

from gshell_mi.capture import CaptureConfig, Distortion, import_capture, network
from gshell_mi.capture.acquire import Acquired, _boxed, _with_priors, lacks_masks, make_masks
from gshell_mi.capture.frames import Capture, Frame
from gshell_mi.capture.segmentation import View, cut_out
from gshell_mi.capture.subject import find_subject
from gshell_mi.capture.workspace import Workspace
from gshell_mi.errors import UserError


@pytest.fixture(scope="module")
def shots():
    """Cameras, photographs and true masks."""
    cameras = photographed.cameras(10, 160, 120)
    images, masks = zip(*(photographed.photograph(camera) for camera in cameras), strict=True)
    return cameras, images, [mask >= 0.5 for mask in masks]


def found(shots, subject):
    cameras, images, truth = shots
    cuts = cut_out([View(image, camera) for image, camera in zip(images, cameras, strict=True)], subject)
    return [photographed.overlap(cut, mask) for cut, mask in zip(cuts, truth, strict=True)]


def test_object_is_cut_from_its_table(shots):
    pytest.importorskip("cv2", reason="needs the extra 'masks'")
    assert min(found(shots, find_subject(shots[0], photographed.points()))) > 0.95


def test_a_box_that_cuts_the_object_grows(shots):
    pytest.importorskip("cv2", reason="needs the extra 'masks'")
    subject = find_subject(shots[0], photographed.points())
    low, high = subject.box
    small = replace(subject, box=np.stack([low, [0.25, 0.8, high[2]]]))
    assert np.mean(found(shots, small)) > 0.95


def test_every_frame_gets_a_mask_once(shots, tmp_path, monkeypatch):
    pytest.importorskip("cv2", reason="needs the extra 'masks'")
    cameras, images, truth = shots
    frames = []
    for index, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        Image.fromarray(image).save(tmp_path / f"{index}.png")
        frames.append(Frame(tmp_path / f"{index}.png", camera))
    capture = Capture("test", tmp_path, tuple(frames))
    assert lacks_masks(capture)
    box = (-0.7, 0.02, -0.7, 0.7, 1.2, 0.7)
    for _ in range(2):
        acquired = Acquired(capture, Workspace(tmp_path / "scene.work"))
        make_masks(acquired, CaptureConfig(box=box), lambda capture: np.eye(4))
        # What is there is not made again.
        monkeypatch.setattr("gshell_mi.capture.acquire.cut_out", None)
    assert acquired.made == ["masks"]
    for frame, mask in zip(acquired.capture.frames, truth, strict=True):
        assert photographed.overlap(np.array(Image.open(frame.mask)) > 0, mask) > 0.9


def test_images_with_alpha_lack_no_masks(tmp_path):
    Image.new("RGBA", (4, 4)).save(tmp_path / "a.png")
    assert not lacks_masks(Capture("test", tmp_path, (Frame(tmp_path / "a.png", None),)))


@pytest.mark.parametrize("name", ["a.png", "b.exr", "c.tif", "d.hdr", "e.pfm", "f.jpg"])
def test_an_alpha_that_says_nothing_is_no_mask(name, tmp_path):
    """Opaque everywhere, or of a kind of file that may hold alpha but has none here."""
    pixels, path = np.ones((6, 8, 4), np.float32), tmp_path / name
    if name.endswith("png"):
        Image.fromarray((255 * pixels).astype(np.uint8)).save(path)
    elif name.endswith("tif"):
        tifffile.imwrite(path, pixels[..., :3], photometric="rgb")
    elif name.endswith("jpg"):
        Image.new("RGB", (8, 6)).save(path)
    else:
        mi.Bitmap(pixels if name.endswith("exr") else pixels[..., :3].copy()).write(str(path))
    assert lacks_masks(Capture("test", tmp_path, (Frame(path, None),)))


def test_masks_are_made_again_for_another_background_or_lens(shots, tmp_path, monkeypatch):
    """Of the same name, too."""
    cameras, images, _ = shots
    Image.fromarray(images[0]).save(tmp_path / "a.png")
    config = CaptureConfig(background=str(tmp_path / "empty.png"), box=(-0.7, 0.02, -0.7, 0.7, 1.2, 0.7))
    calls = []

    def cut(views, subject, progress):
        calls.append(views)
        return [np.zeros((120, 160), np.uint8)]

    def make(camera):
        capture = Capture("test", tmp_path, (Frame(tmp_path / "a.png", camera),))
        make_masks(Acquired(capture, Workspace(tmp_path / "s.work")), config, lambda capture: np.eye(4))
        return len(calls)

    monkeypatch.setattr("gshell_mi.capture.acquire.cut_out", cut)
    Image.fromarray(images[1]).save(tmp_path / "empty.png")
    assert (make(cameras[0]), make(cameras[0])) == (1, 1)
    Image.fromarray(images[2][:, ::-1]).save(tmp_path / "empty.png")
    os.utime(tmp_path / "empty.png", ns=(0, 0))
    assert make(cameras[0]) == 2
    assert make(replace(cameras[0], fy=cameras[0].fy + 1)) == 3
    assert make(replace(cameras[0], distortion=Distortion(k1=0.01))) == 4


def test_a_photograph_of_the_background_comes_before_the_masks_that_are_there(tmp_path, monkeypatch):
    """As a colour does; and makers of masks that have no use for it are refused."""
    write_nerf(tmp_path / "set", known_cameras(3))
    Image.new("RGB", (60, 44)).save(tmp_path / "empty.png")
    full = np.full((44, 60), 255, np.uint8)
    full[:5] = 0
    monkeypatch.setattr("gshell_mi.capture.acquire.cut_out", lambda views, *_: [full] * len(views))
    photograph = str(tmp_path / "empty.png")
    result = import_capture(tmp_path / "set", tmp_path / "s.xml", config=CaptureConfig(background=photograph))
    assert result.made == ("masks",)
    for maker in ("off", "rembg"):
        with pytest.raises(UserError, match=f"is a photograph, .* not {maker}; leave out"):
            CaptureConfig(background=photograph, make_masks=maker)


def test_box_is_told_in_the_scene():
    turned = np.eye(4)
    turned[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # the capture's x is the scene's y
    subject = _boxed(None, np.array([[0.0, 0, 0], [1, 2, 3]]), turned)
    np.testing.assert_allclose(subject.box, [[0, -1, 0], [2, 0, 3]], atol=1e-12)


def test_a_photograph_of_the_background_says_what_differs(shots, tmp_path):
    camera, image, truth = shots[0][0], shots[1][0], shots[2][0]
    empty = image.copy()
    empty[truth] = 255 - empty[truth]
    Image.fromarray(empty).save(tmp_path / "empty.png")
    config = CaptureConfig(background=str(tmp_path / "empty.png"))
    (view,) = _with_priors([View(image, camera)], config)
    assert (view.prior[~truth] < 0.5).all() and (view.prior[truth] >= 0.5).mean() > 0.5
    Image.fromarray(empty[:50]).save(tmp_path / "empty.png")
    with pytest.raises(UserError, match="another aspect"):
        _with_priors([View(image, camera)], config)


def test_missing_extras_are_named(shots, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(UserError, match=r"pip install 'gshell_mi\[masks\]'"):
        found(shots, find_subject(shots[0], photographed.points()))
    monkeypatch.setitem(sys.modules, "rembg", None)
    network._session.cache_clear()
    with pytest.raises(UserError, match=r"pip install 'gshell_mi\[rembg\]'"):
        network.object_probability(shots[1][0])
