"""The folder of a fit while it runs: whose files it replaces, and when."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gshell_mi import UserError
from gshell_mi.export import FitFolder, can_resume
from gshell_mi.own_folder import MARK, OwnFolder


def files(folder: Path) -> dict[str, str]:
    """What is in a folder, by name, but the mark."""
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != MARK
    }


def write(folder: Path, **contents: str) -> None:
    """As an export does: ``views_a`` is ``views/a.png``."""
    names = {"mesh": "mesh.ply", "scene": "scene.xml", "checkpoint": "checkpoint.npz", "log": "log.jsonl"}
    for key, text in contents.items():
        name = names.get(key) or f"views/{key.removeprefix('views_')}.png"
        OwnFolder(folder, "fit").claim(name)
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)


@pytest.fixture
def earlier(tmp_path) -> Path:
    """A finished fit, and two files that no fit wrote."""
    output = tmp_path / "out"
    with FitFolder(output, resume=False, overwrite=False) as folder:
        folder.check([], ["a", "b"])
        folder.prepare()
        write(folder.place, mesh="old", checkpoint="old", views_a="old", views_b="old")
        folder.finish()
    (output / "notes.txt").write_text("mine")
    (output / "views" / "holiday.jpg").write_text("mine")
    return output


def test_a_new_folder_is_made_and_marked(tmp_path):
    output = tmp_path / "a" / "b"
    with FitFolder(output, resume=False, overwrite=False) as folder:
        assert folder.place == output and not (tmp_path / "a").exists(), "a check leaves no trace"
        folder.check([], [])
        folder.prepare()
    assert json.loads((output / MARK).read_text())["kind"] == "fit"


def test_an_earlier_fit_is_kept(earlier):
    before = files(earlier)
    with pytest.raises(UserError, match=r"holds an earlier fit \(checkpoint.npz\); continue it with"):
        FitFolder(earlier, resume=False, overwrite=False).__enter__()
    assert files(earlier) == before


def test_the_earlier_fit_stays_whole_until_the_new_one_is(earlier):
    before = files(earlier)
    with FitFolder(earlier, resume=False, overwrite=True) as folder:
        folder.check([], ["a"])
        folder.prepare()
        write(folder.place, checkpoint="new")
        assert {name: text for name, text in files(earlier).items() if ".unfinished" not in name} == before
        write(folder.place, mesh="new", views_a="new")
        assert {name: text for name, text in files(earlier).items() if ".unfinished" not in name} == before
        folder.finish()
    assert files(earlier) == {
        "mesh.ply": "new",
        "checkpoint.npz": "new",
        "views/a.png": "new",
        "notes.txt": "mine",
        "views/holiday.jpg": "mine",
    }
    assert OwnFolder(earlier, "fit").files == {"mesh.ply", "checkpoint.npz", "views/a.png"}
    assert not list(earlier.glob(".*"))


def test_what_an_interrupted_overwriting_has_left_is_resumed(earlier):
    with FitFolder(earlier, resume=False, overwrite=True) as folder:
        folder.check([], ["a"])
        folder.prepare()
        assert not can_resume(earlier), "the checkpoint there is the earlier fit's"
        write(folder.place, checkpoint="half")
    assert can_resume(earlier)
    with FitFolder(earlier, resume=True, overwrite=False) as folder:
        assert (folder.place / "checkpoint.npz").read_text() == "half"
        folder.check([], ["a"])
        folder.prepare()
        assert (folder.place / "checkpoint.npz").read_text() == "half"
        write(folder.place, mesh="new", checkpoint="whole")
        folder.finish()
    assert files(earlier)["mesh.ply"] == "new" and files(earlier)["checkpoint.npz"] == "whole"
    assert "views/a.png" not in files(earlier) and can_resume(earlier)


def test_overwriting_anew_starts_anew(earlier):
    with FitFolder(earlier, resume=False, overwrite=True) as folder:
        folder.check([], ["a"])
        folder.prepare()
        write(folder.place, checkpoint="half", mesh="half", views_b="half")
    with FitFolder(earlier, resume=False, overwrite=True) as folder:
        folder.check([], ["a"])
        folder.prepare()
        write(folder.place, checkpoint="new")
        folder.finish()
    assert files(earlier) == {"checkpoint.npz": "new", "notes.txt": "mine", "views/holiday.jpg": "mine"}


@pytest.mark.parametrize("killed_after", range(3))
def test_killed_while_the_new_files_move_in(earlier, monkeypatch, killed_after):
    """Every file is whole, and going on brings all of the new ones."""
    with FitFolder(earlier, resume=False, overwrite=True) as folder:
        folder.check([], ["a"])
        folder.prepare()
        write(folder.place, mesh="new", checkpoint="new", views_a="new")
        moved, replace = [], os.replace

        def kill(source, target):
            if ".unfinished" in str(source) and ".partial." not in str(source):
                if len(moved) == killed_after:
                    raise KeyboardInterrupt
                moved.append(target)
            replace(source, target)

        monkeypatch.setattr(os, "replace", kill)
        with pytest.raises(KeyboardInterrupt):
            folder.finish()
        monkeypatch.undo()
    assert set(files(earlier).values()) <= {"old", "new", "mine"}
    with FitFolder(earlier, resume=True, overwrite=False) as folder:
        folder.check([], ["a"])
        folder.prepare()
        write(folder.place, mesh="new", checkpoint="new", views_a="new")  # a resumed fit exports again
        folder.finish()
    assert files(earlier) == {
        "mesh.ply": "new",
        "checkpoint.npz": "new",
        "views/a.png": "new",
        "notes.txt": "mine",
        "views/holiday.jpg": "mine",
    }
    assert not list(earlier.glob(".*"))


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["scene.xml", "mesh.ply", "light.exr", "views/a.png", "log.jsonl"])
def test_what_no_fit_wrote_is_in_the_way(tmp_path, name, overwrite):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("precious")
    before = files(tmp_path)
    with (
        pytest.raises(UserError, match=f"{name}' is in the way: gshell_mi.fit has not written it there"),
        FitFolder(tmp_path, resume=False, overwrite=overwrite) as folder,
    ):
        folder.check([], ["a"])
        folder.prepare()
    assert files(tmp_path) == before and not (tmp_path / MARK).exists()


def test_a_link_is_never_written_through(earlier, tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("precious")
    (earlier / "mesh.ply").unlink()
    (earlier / "mesh.ply").symlink_to(precious)
    with pytest.raises(UserError, match=r"mesh.ply' is in the way"):
        FitFolder(earlier, resume=False, overwrite=True).__enter__()
    (earlier / "mesh.ply").unlink()
    away = tmp_path / "away"
    (earlier / "views").rename(away)
    (earlier / "views").symlink_to(away)
    with (
        pytest.raises(UserError, match="views' is in the way"),
        FitFolder(earlier, resume=False, overwrite=True) as folder,
    ):
        folder.check([], ["a"])
        folder.prepare()
    assert set(files(away)) == {"a.png", "b.png", "holiday.jpg"} and precious.read_text() == "precious"


@pytest.mark.parametrize(
    "mark",
    [
        '{"kind": "fit", "files": ["../precious.txt", "notes.txt", "/etc/hosts", "views/../notes.txt", 5]}',
        '{"kind": "fit", "files": "notes.txt"}',
        "[]",
        "5",
        "{",
        '{"kind": ["fit"]}',
        "[" * 100_000,
        "\udc80",
    ],
)
def test_a_strangers_mark_is_not_believed(tmp_path, mark):
    """Only names that a fit writes are ever removed, whatever the mark lists."""
    output = tmp_path / "out"
    output.mkdir()
    (tmp_path / "precious.txt").write_text("precious")
    (output / "notes.txt").write_text("mine")
    (output / MARK).write_text(mark, errors="surrogateescape")
    with FitFolder(output, resume=False, overwrite=True) as folder:
        folder.check([], [])
        folder.prepare()
        folder.finish()
    assert files(tmp_path) == {"precious.txt": "precious", "out/notes.txt": "mine"}


def test_a_folder_of_another_kind(tmp_path):
    OwnFolder(tmp_path, "capture").write_mark(["sensors.xml"])
    for overwrite in (False, True):
        with pytest.raises(UserError, match=r"was written by gshell_mi.capture; choose another place"):
            FitFolder(tmp_path, resume=False, overwrite=overwrite).__enter__()


@pytest.mark.parametrize("link", [False, True])
def test_inputs_are_not_replaced(earlier, tmp_path, link):
    """Such as a mesh or a light of the earlier fit, also under another name."""
    given = earlier / "mesh.ply"
    if link:
        given = tmp_path / "given.ply"
        given.symlink_to(earlier / "mesh.ply")
    before = files(earlier)
    with (
        pytest.raises(UserError, match=f"{given.name}' is read by this run and would be replaced by it"),
        FitFolder(earlier, resume=False, overwrite=True) as folder,
    ):
        folder.check([given], ["a"])
        folder.prepare()
    assert files(earlier) == before


def test_a_folder_below_a_file(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot be made because '.*file' is a file"):
        FitFolder(tmp_path / "file" / "out", resume=False, overwrite=False).__enter__()


def test_two_fits_exclude_each_other(tmp_path):
    """In one process and in two; the lock goes with the process that holds it, however that ends."""
    with FitFolder(tmp_path, resume=False, overwrite=False) as folder:
        folder.check([], [])
        folder.prepare()
    code = f"""if True:
        import sys, time
        from gshell_mi.export import FitFolder
        with FitFolder({str(tmp_path)!r}, resume=False, overwrite=False) as folder:
            folder.check([], [])
            folder.prepare()
            print("ready", flush=True)
            time.sleep(60)
    """
    other = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "ready\n"
        for resume in (False, True):
            with pytest.raises(UserError, match="Another run is writing into"):
                FitFolder(tmp_path, resume=resume, overwrite=True).__enter__()
    finally:
        other.kill()
        other.communicate()
    with FitFolder(tmp_path, resume=False, overwrite=False) as folder:
        folder.check([], [])
        folder.prepare()


@pytest.mark.skipif(os.name == "posix" and os.geteuid() == 0, reason="root may write anywhere")
def test_nothing_goes_where_not_all_can_go(earlier):
    before = files(earlier)
    (earlier / "views").chmod(0o500)
    try:
        with (
            pytest.raises(UserError, match=r"views' cannot be written \(Permission denied\)"),
            FitFolder(earlier, resume=False, overwrite=True) as folder,
        ):
            folder.check([], ["a"])
            folder.prepare()
    finally:
        (earlier / "views").chmod(0o700)
    assert files(earlier) == before
