"""Steps that are kept, and what is never touched."""

import pytest

from gshell_mi.capture.workspace import Workspace, fingerprint
from gshell_mi.errors import UserError


def test_a_step_is_kept_for_its_job_only(tmp_path):
    folder = Workspace(tmp_path / "scene.work").step("cut", {"size": 1})
    (folder / "result").touch()
    assert (Workspace(tmp_path / "scene.work").step("cut", {"size": 1}) / "result").is_file()
    assert not (Workspace(tmp_path / "scene.work").step("cut", {"size": 2}) / "result").exists()


def test_a_changed_file_is_another_job(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"1")
    before = fingerprint([tmp_path / "a.jpg"])
    (tmp_path / "a.jpg").write_bytes(b"22")
    assert fingerprint([tmp_path / "a.jpg"]) != before


@pytest.mark.parametrize("name", ["thesis.tex", "steps.json"])
def test_a_folder_of_somebody_else_is_left_alone(tmp_path, name):
    (tmp_path / "scene.work").mkdir()
    (tmp_path / "scene.work" / name).write_text("precious")
    with pytest.raises(UserError, match="was not made by gshell_mi"):
        Workspace(tmp_path / "scene.work")
    assert (tmp_path / "scene.work" / name).read_text() == "precious"


def test_a_place_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        Workspace(tmp_path / "file" / "scene.work").step("cut", {})
