import json

import pytest

from gshell_mi import UserError
from gshell_mi.own_folder import MARK, TAG, OwnFolder, check_own_file, is_own_file, own_folder


def write(folder, **texts):
    for name, text in texts.items():
        (folder / f"{name}.exr").write_text(text)


def contents(folder) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in folder.rglob("*")
        if path.is_file() and path.name != MARK
    }


@pytest.fixture
def own(tmp_path) -> OwnFolder:
    """The folder of an import with two views, and notes."""
    folder = tmp_path / "s"
    folder.mkdir()
    write(folder, view_000="old", view_001="old")
    (folder / "notes.txt").write_text("mine")
    found = OwnFolder(folder, "capture")
    found.write_mark(["view_000.exr", "view_001.exr"], "s.xml")
    return found


def test_only_what_was_listed_is_ours(own):
    assert own.present() == ["view_000.exr", "view_001.exr"]
    assert own.lists_beside("s.xml") and not own.lists_beside("t.xml")
    assert own.foreign(["view_000.exr"]) is None and own.foreign(["view_007.exr"]) is None
    assert own.foreign(["notes.txt"]) == own.path / "notes.txt"
    with pytest.raises(UserError, match=r"notes.txt' is in the way: gshell_mi.capture has not written it"):
        own.claim("notes.txt")


def test_what_is_claimed_is_listed_before_it_is_there(own):
    own.claim("view_002.exr")
    assert "view_002.exr" in own.files and "view_002.exr" not in own.present()
    own.check_free(["view_002.exr"])
    assert own.lists_beside("s.xml"), "the rest of the mark stays"


def test_new_files_take_the_place_of_old_ones(own, tmp_path):
    staged = tmp_path / "staged"
    (staged / "test").mkdir(parents=True)
    write(staged, view_000="new")
    write(staged / "test", test_000="new")
    own.take_over(staged, last="view_000.exr", beside="s.xml")
    assert contents(own.path) == {"view_000.exr": "new", "test/test_000.exr": "new", "notes.txt": "mine"}
    assert own.files == {"view_000.exr", "test/test_000.exr"} and not contents(staged)


def test_nothing_changes_if_something_is_in_the_way(own, tmp_path):
    staged = tmp_path / "staged"
    staged.mkdir()
    write(staged, view_000="new", view_007="new")
    write(own.path, view_007="a photograph")
    before = contents(own.path)
    with pytest.raises(UserError, match=r"view_007.exr' is in the way"):
        own.take_over(staged, last="view_000.exr")
    assert contents(own.path) == before and len(contents(staged)) == 2


def test_removing_leaves_what_is_not_ours(own):
    own.remove()
    assert contents(own.path) == {"notes.txt": "mine"} and not own.is_marked()
    (own.path / "notes.txt").unlink()
    own.write_mark([])
    own.remove()
    assert not own.path.exists()


@pytest.mark.parametrize(
    "name",
    [
        "../a.exr",
        "/etc/view_000.exr",
        "test/../view_000.exr",
        "notes.txt",
        "",
        "view_000.exr/",
        "./view_000.exr",
        "test/a/test_0.exr",
        5,
        None,
    ],
)
def test_a_mark_is_believed_in_names_of_its_kind_alone(own, name):
    mark = json.loads((own.path / MARK).read_text())
    (own.path / MARK).write_text(json.dumps(mark | {"files": [name]}))
    assert own.files == set()


def test_another_kind(own):
    with pytest.raises(UserError, match=r"was written by gshell_mi.capture; choose another place"):
        OwnFolder(own.path, "fit").claim("mesh.ply")
    with pytest.raises(UserError, match=r"was written by gshell_mi.capture"), own_folder(own.path, "fit"):
        pass


def test_inputs_under_any_name(own, tmp_path):
    (tmp_path / "link.exr").symlink_to(own.path / "view_001.exr")
    own.check_inputs([own.path / "notes.txt", tmp_path / "none.exr"])
    for path in (own.path / "view_001.exr", tmp_path / "link.exr", own.path / ".." / "s" / "view_001.exr"):
        with pytest.raises(UserError, match="is read by this run and would be replaced by it"):
            own.check_inputs([path])


def test_errors_of_the_disk_become_sentences(own):
    with (
        pytest.raises(UserError, match=r"'.*a.exr' cannot be read or written \(No space left on device\)"),
        own_folder(own.path, "capture"),
    ):
        raise OSError(28, "No space left on device", "a.exr")
    with pytest.raises(UserError, match="is no folder"), own_folder(own.path / "none", "capture"):
        pass


def test_single_files_tell_who_wrote_them(tmp_path):
    for name, text, ours in (("a", TAG, True), ("b", "x" * 3_000_000 + TAG, True), ("c", "holiday", False)):
        (tmp_path / name).write_text(text)
        assert is_own_file(tmp_path / name) == ours
    check_own_file(tmp_path / "a")
    check_own_file(tmp_path / "none")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "a")
    for name in ("c", "folder", "link"):
        with pytest.raises(UserError, match="exists and was not written by gshell_mi, so it is left alone"):
            check_own_file(tmp_path / name)
