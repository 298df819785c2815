"""What a photograph does not tell."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from known_capture import known_cameras, write_colmap
from PIL import Image
from scipy import ndimage

from gshell_mi.capture import Camera, CaptureConfig, import_capture
from gshell_mi.capture.check import check_scene
from gshell_mi.capture.evidence import wide_grey
from gshell_mi.capture.region import Carving, Silhouette
from gshell_mi.errors import UserError
from gshell_mi.scene import load_fit_scene
from gshell_mi.targets import load_target


def disk(size=100, radius=30):
    v, u = np.mgrid[:size, :size] - size / 2 + 0.5
    return np.clip(radius - np.hypot(u, v) + 0.5, 0, 1).astype(np.float32)


def test_an_outlines_grey_is_coverage_and_a_wide_one_is_doubt():
    mask = disk()
    assert ((mask > 0.1) & (mask < 0.9)).any() and not wide_grey(mask).any()
    mask[40:60, :30] = 0.5
    expected = np.zeros_like(mask, bool)
    expected[40:60, :30] = True
    np.testing.assert_array_equal(wide_grey(mask) & (mask == 0.5), expected)
    assert (wide_grey(mask) & ~ndimage.binary_dilation(expected, iterations=3)).sum() == 0
    assert wide_grey(ndimage.gaussian_filter(disk(), 6)).any()  # a feathered selection


@pytest.fixture
def capture(tmp_path):
    """A COLMAP capture of which image 01's mask doubts a corner, and image 02 has an ignore mask."""
    write_colmap(tmp_path / "set", known_cameras(4, up=(0.1, -1, 0.2)))
    path = tmp_path / "set" / "masks" / "IMG 01.png.png"
    mask = np.array(Image.open(path))
    mask[:12, :16] = 128
    Image.fromarray(mask).save(path)
    ignored = np.zeros((44, 60), np.uint8)
    ignored[:, :20] = 255
    (tmp_path / "set" / "ignore").mkdir()
    Image.fromarray(ignored).save(tmp_path / "set" / "ignore" / "IMG 02.png")
    return tmp_path / "set"


def test_doubt_goes_from_masks_to_targets(capture, tmp_path):
    scene = import_capture(capture, tmp_path / "scene.xml").path
    names = sorted(path.name for path in (tmp_path / "scene").glob("*.known.exr"))
    assert names == ["view_001.known.exr", "view_002.known.exr"]
    known = [target.known for target in load_fit_scene(scene).targets]
    assert (known[0] == 1).all() and (known[3] == 1).all() and known[0].shape == (44, 60)
    expected = np.ones((44, 60))
    expected[:12, :16] = 0
    np.testing.assert_array_equal(known[1], expected)
    assert (known[2][:, :20] == 0).all() and (known[2][:, 20:] == 1).all()
    picture = check_scene(scene).picture
    blue = (np.array(Image.open(picture)).astype(int) @ [-1, -1, 2] > 120).sum()
    assert blue > 2000


def test_ignore_masks_of_another_folder_and_shape(capture, tmp_path):
    Image.new("L", (9, 9)).save(capture / "ignore" / "IMG 02.png")
    (capture / "ignore").rename(capture / "elsewhere")
    with pytest.raises(UserError, match="9 x 9 pixels, but its image is 60 x 44"):
        import_capture(capture, tmp_path / "scene.xml", config=CaptureConfig(ignore=capture / "elsewhere"))
    (capture / "elsewhere" / "IMG 02.png").write_text("white")
    with pytest.raises(UserError, match="cannot be read"):
        import_capture(capture, tmp_path / "scene.xml", config=CaptureConfig(ignore=capture / "elsewhere"))


def test_what_lies_beside_the_frame_is_unknown(tmp_path):
    """A pincushion lens: the straightened image's corners are in no photograph."""
    write_colmap(tmp_path / "set", known_cameras(3, lens={"k1": 0.4}), model="SIMPLE_RADIAL")
    scene = import_capture(tmp_path / "set", tmp_path / "scene.xml").path
    for target in load_fit_scene(scene).targets:
        assert target.known[0, 0] == 0 and target.known[-1, -1] == 0
        assert (target.known[15:30, 20:40] == 1).all()
    barrel = tmp_path / "barrel"
    write_colmap(barrel, known_cameras(3, lens={"k1": -0.1}), model="SIMPLE_RADIAL")
    import_capture(barrel, tmp_path / "other.xml")
    assert not list((tmp_path / "other").glob("*.known.exr"))


def test_nothing_is_carved_where_nothing_is_known():

    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0, np.eye(4))
    view = Silhouette(camera, disk())
    beside = np.array([[0.42, 0.0, 1.0], [0.0, 0.0, 1.0]])
    assert Carving([view]).keeps(beside, 0.0).tolist() == [False, True]
    known = np.ones((100, 100), np.float32)
    known[:, 80:] = 0
    assert Carving([replace(view, known=known)]).keeps(beside, 0.0).tolist() == [True, True]


@pytest.mark.parametrize(
    "values, words",
    [
        (np.full((4, 6), 0.5), None),
        (np.full((4, 5), 1.0), "5 x 4 pixels"),
        (np.full((4, 6), 2.0), "no shares"),
        (np.full((4, 6), np.nan), "no shares"),
        (np.arange(72.0).reshape(4, 6, 3) / 72, "different channels"),
    ],
)
def test_known_files_of_targets(values, words, tmp_path):
    mi.Bitmap(np.ones((4, 6, 4), np.float32)).write(str(tmp_path / "a.exr"))
    mi.Bitmap(values.astype(np.float32)).write(str(tmp_path / "a.known.exr"))
    if words is None:
        assert (load_target(tmp_path / "a.exr", 6, 4).known == 0.5).all()
        return
    with pytest.raises(UserError, match=words):
        load_target(tmp_path / "a.exr", 6, 4)


def test_everything_is_known_by_default(tmp_path):
    mi.Bitmap(np.ones((4, 6, 4), np.float32)).write(str(tmp_path / "a.exr"))
    assert (load_target(tmp_path / "a.exr", 6, 4).known == np.ones((4, 6))).all()
    (tmp_path / "a.known.exr").write_bytes(b"no image")
    with pytest.raises(UserError, match="cannot be read"):
        load_target(tmp_path / "a.exr", 6, 4)
