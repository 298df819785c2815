import os
import subprocess
import sys
import threading

import pytest

from gshell_mi import UserError
from gshell_mi.files import locked, name_trouble, remove_stale, replacing


def names(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_failed_writing_leaves_the_old_file(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(ValueError, match="half"), replacing(tmp_path / "a.txt") as partial:
        partial.write_text("new")
        raise ValueError("half")
    assert names(tmp_path) == ["a.txt"] and (tmp_path / "a.txt").read_text() == "old"


def test_planted_links_are_not_written_through(tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("precious")
    (tmp_path / ".partial.mesh.ply").symlink_to(precious)
    (tmp_path / "mesh.ply").symlink_to(precious)
    with replacing(tmp_path / "mesh.ply") as partial:
        assert partial.suffix == ".ply" and partial.name not in (".partial.mesh.ply", "mesh.ply")
        partial.write_text("mesh")
    assert precious.read_text() == "precious"
    assert (tmp_path / "mesh.ply").read_text() == "mesh" and not (tmp_path / "mesh.ply").is_symlink()


def test_files_have_the_usual_permissions(tmp_path):
    with replacing(tmp_path / "a.txt") as partial:
        partial.write_text("a")
    (tmp_path / "b.txt").write_text("b")
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "b.txt").stat().st_mode


def test_two_writers_of_one_file(tmp_path):
    """Each is whole, and the last one stays."""
    with replacing(tmp_path / "a.txt") as first, replacing(tmp_path / "a.txt") as second:
        first.write_text("first")
        second.write_text("second")
        assert first != second
    assert (tmp_path / "a.txt").read_text() == "first" and names(tmp_path) == ["a.txt"]


def writer(folder, code: str) -> subprocess.Popen:
    """A process that has begun to write a file or locked a folder, and waits."""
    lines = f"""if True:
        import sys, time
        from pathlib import Path
        from gshell_mi.files import locked, replacing
        folder = Path({str(folder)!r})
        with {code} as partial:
            print("ready", flush=True)
            time.sleep(60)
    """
    process = subprocess.Popen([sys.executable, "-c", lines], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    return process


def test_what_a_killed_run_was_writing_goes_and_what_a_run_is_writing_stays(tmp_path):
    process = writer(tmp_path, "replacing(folder / 'a.txt')")
    (partial,) = tmp_path.iterdir()
    old = partial.stat().st_mtime - 60
    os.utime(partial, (old, old))
    (tmp_path / "notes.txt").write_text("mine")
    download = tmp_path / ".partial.my_download.zip"
    download.write_text("mine too")
    os.utime(download, (old, old))
    try:
        remove_stale(tmp_path)
        assert partial.exists()
    finally:
        process.kill()
        process.communicate()
    remove_stale(tmp_path)
    assert names(tmp_path) == [".partial.my_download.zip", "notes.txt"]


def test_a_lock_goes_with_its_owner(tmp_path):
    process = writer(tmp_path, "locked(folder)")
    try:
        with pytest.raises(UserError, match=f"Another run is writing into '{tmp_path}'"), locked(tmp_path):
            pass
    finally:
        process.kill()
        process.communicate()
    with locked(tmp_path):
        assert names(tmp_path) == []


def test_a_thread_takes_its_lock_again_and_another_does_not(tmp_path):
    told = []

    def work():
        try:
            with locked(tmp_path):
                told.append("got it")
        except UserError as error:
            told.append(str(error))

    with locked(tmp_path):
        with locked(tmp_path):
            pass
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert len(told) == 1 and "Another run" in told[0]
    work()
    assert told[1] == "got it"


@pytest.mark.parametrize(
    ("name", "trouble"),
    [
        ("view_000", None),
        ("Möbel, 2. Versuch", None),
        (".hidden", None),
        ("", "is no name"),
        ("a\0b", "printed"),
        ("a\nb", "printed"),
        ("a\udc80", "printed"),
        ("x" * 201, "longer"),
        ("..", "is no name"),
        ("a/b", "'/'"),
        ("$spp", "Mitsuba takes for a parameter"),
    ],
)
def test_names(name, trouble):
    found = name_trouble(name)
    assert found is None if trouble is None else trouble in found


def test_names_that_no_scene_holds():
    assert name_trouble("$x.mp4", in_scene=False) is None
    assert name_trouble("..", in_scene=False) == "is no name"
