"""Which file a name means."""

import numpy as np
import pytest
from known_capture import CAPTURES

from gshell_mi.capture import read_capture
from gshell_mi.capture.file_names import Copies, existing


@pytest.fixture
def folder(tmp_path):
    def make(*names):
        for name in names:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_bytes(b"")
        return tmp_path

    return make


@pytest.mark.parametrize(
    "there, named, found",
    [
        ("a.png", "a.png", "a.png"),
        ("a.png", "a", "a.png"),
        ("a.PNG", "a", "a.PNG"),
        ("a.PNG", "a.png", "a.PNG"),
        ("a.jpg", "a.JPG", "a.jpg"),
        ("a.1.png", "a.1", "a.1.png"),
        ("A.png", "a.png", None),
        ("a.png", "b.png", None),
        ("u\u0308.png", "\u00fc.png", "u\u0308.png"),
        ("\u00fc.JPG", "u\u0308", "\u00fc.JPG"),
        ("fu\u0308r/e\u0301/a.png", "f\u00fcr/\u00e9/a.png", "fu\u0308r/e\u0301/a.png"),
        ("u.png", "\u00fc.png", None),
        ("u/a.png", "\u00fc/a.png", None),
        ("a.png", "a.jpg", None),
        ("a.png", "x" * 300, None),
        ("a.png", "a\0.png", None),
        ("a.png", "", None),
    ],
)
def test_suffixes_may_be_left_out_or_in_another_case(there, named, found, folder):
    place = folder(there)
    assert existing(place / named) == (place / found if found else None)


def test_an_exact_name_comes_first(folder):
    place = folder("a.PNG", "a.png", "a.jpg")
    assert existing(place / "a.png") == place / "a.png"


def test_files_that_appear_later_are_seen(folder):
    place = folder("b.PNG")
    assert existing(place / "a.png") is None
    folder("a.PNG")
    assert existing(place / "a.png") == place / "a.PNG"


@pytest.mark.parametrize(
    "names, there, found",
    [
        (["images/a.png", "images/b.png"], ["a.png", "b.png"], ["a.png", "b.png"]),
        (["C:\\pictures\\a.png", "/home/x/b.png"], ["a.png", "b.png"], ["a.png", "b.png"]),
        (["images/l/0.png", "images/r/0.png"], ["l/0.png", "r/0.png"], ["l/0.png", "r/0.png"]),
        (["images/l/0.png", "images/r/0.png"], ["0.png"], [None, None]),
        (["images/l/0.png", "images/r/1.png"], ["0.png", "r/1.png", "1.png"], ["0.png", "r/1.png"]),
        (["./images/a", "images/a"], ["a.JPG"], ["a.JPG", "a.JPG"]),
        (["s/l/0.jpg", "s/r/0.png"], ["0.png"], [None, None]),
    ],
)
def test_counterparts_in_another_folder(names, there, found, folder):
    place, copies = folder(*there), Copies(names)
    assert [copies.find(place, name) for name in names] == [place / name if name else None for name in found]


@pytest.mark.parametrize("name", [name for name in CAPTURES if not name.startswith("mitsuba")])
def test_a_capture_in_capitals(name, tmp_path):
    """As it comes from a system that does not tell them from small letters."""
    cameras, write = CAPTURES[name]
    write(tmp_path, cameras)
    expected = read_capture(tmp_path)
    named = any(tmp_path.glob("transforms*.json"))
    for path in sorted(tmp_path.rglob("*"), key=lambda path: -len(path.parts)):
        # Images, and their folders where a document names them, keep their names.
        if path.suffix in (".txt", ".bin", ".json", ".npz", ".npy") or (path.is_dir() and not named):
            path.rename(path.with_name(path.name.upper()))
    found = read_capture(tmp_path)
    assert [frame.image.name for frame in found.frames] == [frame.image.name for frame in expected.frames]
    for frame, other in zip(found.frames, expected.frames, strict=True):
        np.testing.assert_array_equal(frame.camera.to_world, other.camera.to_world)
