"""What an import may replace: the files of an earlier one, and nothing else."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from bowl import sensors_xml
from known_capture import known_cameras, write_nerf
from PIL import Image

from gshell_mi.capture import CaptureConfig, import_capture
from gshell_mi.capture.check import check_scene
from gshell_mi.capture.staging import staged
from gshell_mi.errors import UserError
from gshell_mi.own_folder import MARK

FEW = CaptureConfig(resolution=32)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    write_nerf(folder, known_cameras(6))
    return folder


@pytest.fixture
def imported(photographs, tmp_path) -> Path:
    """The folder of the scene ``s.xml``, imported once."""
    shutil.copytree(photographs, tmp_path / "set")
    import_capture(tmp_path / "set", tmp_path / "s.xml", config=FEW)
    return tmp_path / "s"


def again(folder: Path, **options):
    return import_capture(
        folder.parent / "set",
        folder.with_suffix(".xml"),
        overwrite=True,
        config=CaptureConfig(resolution=48, **options),
    )


def test_what_lies_in_the_folder_stays(imported):
    (imported / "my_notes.txt").write_text("mine")
    (imported / "images").mkdir()
    (imported / "images" / "view_000.exr").write_text("mine")
    again(imported)
    assert (imported / "my_notes.txt").read_text() == "mine"
    assert (imported / "images" / "view_000.exr").read_text() == "mine"
    assert 'value="48"' in imported.with_suffix(".xml").read_text()


@pytest.mark.parametrize("where", ["s/images", "s"])
def test_photographs_in_the_folder_stay(imported, where):
    """Also where they are called as targets are."""
    place = imported.parent / where
    shutil.move(imported.parent / "set" / "train", place / "train")
    document = imported.parent / "set" / "transforms_train.json"
    document.write_text(document.read_text().replace("./train/", f"../{where}/train/"))
    before = contents(place / "train")
    assert len(before) >= 6
    again(imported)
    assert contents(place / "train") == before


def write_mitsuba(folder: Path, suffix: str = ".exr") -> None:
    """A capture of three sensors whose images are called ``view_000.exr`` and so on."""
    folder.mkdir()
    sensors = sensors_xml(3, 32)
    (folder / "sensors.xml").write_text(f'<scene version="3.0.0">{"".join(sensors)}</scene>')
    rgba = np.zeros((32, 32, 4), np.float32)
    rgba[8:24, 8:24] = 1
    for index in range(3):
        mi.Bitmap(rgba).write(str(folder / f"view_{index:03}{suffix}"))


def test_photographs_with_the_names_of_targets_stay(imported):
    """Images that an earlier import wrote, and a new one would read and replace."""
    write_mitsuba(imported.parent / "other")
    for image in (imported.parent / "other").glob("*.exr"):
        image.rename(imported / image.name)
    before = contents(imported)
    with pytest.raises(UserError, match=r"view_000.exr' is read by this run and would be replaced by it"):
        import_capture(
            imported.parent / "other",
            imported.with_suffix(".xml"),
            overwrite=True,
            config=CaptureConfig(images=imported, box=(-1, -1, -1, 1, 1, 1)),
        )
    assert contents(imported) == before


def test_photographs_in_the_way_of_targets_stay(imported):
    mark = imported / MARK
    mark.write_text(mark.read_text().replace('"view_003.exr",', ""))
    (imported / "view_003.exr").write_text("a photograph")
    before = contents(imported.parent)
    with pytest.raises(UserError, match=r"view_003.exr' is in the way"):
        again(imported)
    assert contents(imported.parent) == before


def test_a_light_that_is_read_stays(imported):
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(imported.parent / "sky.exr"))
    again(imported, light=imported.parent / "sky.exr")
    before = contents(imported)
    with pytest.raises(UserError, match=r"light.exr' is read by this run and would be replaced by it"):
        again(imported, light=imported / "light.exr")
    assert contents(imported) == before


def test_calibration_stays(tmp_path):
    write_mitsuba(tmp_path / "mit")
    before = contents(tmp_path)
    with pytest.raises(UserError, match=r"sensors.xml' was not written by gshell_mi.capture, so --overwrite"):
        import_capture(tmp_path / "mit", tmp_path / "mit" / "sensors.xml", overwrite=True)
    assert contents(tmp_path) == before


def test_a_strangers_scene_stays(photographs, tmp_path):
    (tmp_path / "u.xml").write_text("mine")
    with pytest.raises(UserError, match=r"u.xml' exists; replace it with --overwrite"):
        import_capture(photographs, tmp_path / "u.xml")
    with pytest.raises(UserError, match=r"u.xml' was not written by gshell_mi.capture"):
        import_capture(photographs, tmp_path / "u.xml", overwrite=True)
    assert contents(tmp_path) == {"u.xml": b"mine"}


def test_a_linked_scene_or_folder_stays(imported, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    imported.rename(tmp_path / "elsewhere" / "s")
    imported.symlink_to(tmp_path / "elsewhere" / "s")
    before = contents(tmp_path / "elsewhere")
    with pytest.raises(UserError, match=r"was not written by gshell_mi.capture"):
        again(imported)
    assert contents(tmp_path / "elsewhere") == before


def test_the_picture_of_the_earlier_views_goes_and_anothers_stays(imported):
    report = check_scene(imported.with_suffix(".xml"))
    assert Image.open(report.picture).text["Software"] == "written by gshell_mi"
    check_scene(imported.with_suffix(".xml"))
    again(imported)
    assert not report.picture.exists()
    report.picture.write_bytes(b"mine")
    with pytest.raises(UserError, match=r"check.png' exists and was not written by gshell_mi"):
        check_scene(imported.with_suffix(".xml"))
    again(imported)
    assert report.picture.read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (".", "must end in .xml"),
        ("", "must end in .xml"),
        ("..", "must end in .xml"),
        ("/", "must end in .xml"),
        ("{}/my$vase.xml", r"has a '\$', which Mitsuba takes for a parameter"),
        ("{}/a\nb.xml", "has characters that cannot be printed"),
        ("{}/a\udc80.xml", "cannot be printed"),
        ("{}/" + "x" * 300 + ".xml", "is longer than 200 bytes"),
    ],
)
def test_outputs_that_cannot_be(photographs, tmp_path, monkeypatch, name, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=words):
        import_capture(photographs, name.format(tmp_path))
    assert list(tmp_path.iterdir()) == []


def importing(output: Path) -> subprocess.Popen:
    """A process that has begun to import, and waits."""
    code = f"""if True:
        import time
        from pathlib import Path
        from gshell_mi.capture.staging import staged
        with staged(Path({str(output)!r}), overwrite=True, source=Path("/none")) as staging:
            (staging.path / "half").write_text("")
            print("ready", flush=True)
            time.sleep(60)
    """
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    return process


def test_two_imports_exclude_each_other_and_a_killed_one_leaves_nothing_for_long(photographs, tmp_path):
    process = importing(tmp_path / "s.xml")
    try:
        with pytest.raises(UserError, match="Another run is writing into"):
            import_capture(photographs, tmp_path / "s.xml")
        import_capture(photographs, tmp_path / "t.xml", config=FEW)
    finally:
        process.kill()
        process.communicate()
    assert (tmp_path / ".s.partial" / "half").exists()
    import_capture(photographs, tmp_path / "s.xml", config=FEW)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s", "s.xml", "t", "t.xml"]


@pytest.mark.parametrize("moves", range(0, 10, 3))
def test_killed_while_the_new_files_move_in(imported, monkeypatch, moves):
    """There is the earlier scene, the new one, or none; every file is whole; a new import brings all."""
    (imported / "notes.txt").write_text("mine")
    old, replace, moved = contents(imported.parent), os.replace, []

    def kill(source, target):
        if ".s.partial" in f"{source}{target}":
            if len(moved) == moves:
                raise KeyboardInterrupt
            moved.append(target)
        replace(source, target)

    monkeypatch.setattr(os, "replace", kill)
    with pytest.raises(KeyboardInterrupt):
        again(imported)
    monkeypatch.undo()
    there = contents(imported.parent)
    assert there["s/notes.txt"] == b"mine"
    if moves == 0:
        assert {name: data for name, data in there.items() if MARK not in name} == {
            name: data for name, data in old.items() if MARK not in name
        }
    else:
        assert "s.xml" not in there
    again(imported)
    monkeypatch.undo()
    shutil.copytree(imported.parent / "set", imported.parent / "fresh" / "set")
    import_capture(
        imported.parent / "fresh" / "set",
        imported.parent / "fresh" / "s.xml",
        config=CaptureConfig(resolution=48),
    )
    fresh = {name for name in contents(imported.parent / "fresh" / "s")}
    assert set(contents(imported)) == fresh | {"notes.txt"}


def test_a_planted_link_is_no_place_to_work(tmp_path):
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "a.txt").write_text("precious")
    (tmp_path / ".s.partial").symlink_to(tmp_path / "precious")
    with (
        pytest.raises(UserError, match=r".s.partial' is in the way and is a link"),
        staged(tmp_path / "s.xml", overwrite=False, source=tmp_path / "none"),
    ):
        pass
    assert (tmp_path / "precious" / "a.txt").read_text() == "precious"
