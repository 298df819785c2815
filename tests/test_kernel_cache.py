"""A place that kernels cannot be kept in is told, as each run compiles them again then."""

import os
import subprocess
import sys

import pytest

from gshell_mi.kernel_cache import kernel_cache_problem


@pytest.fixture
def environment(monkeypatch):
    monkeypatch.delenv("DRJIT_CACHE_DIR", raising=False)
    return monkeypatch


def test_a_folder_that_can_be_written_is_none(environment, tmp_path):
    environment.setenv("HOME", str(tmp_path))
    assert kernel_cache_problem() is None
    environment.setenv("HOME", "/dev/null")
    environment.setenv("DRJIT_CACHE_DIR", str(tmp_path / "yet" / "to_be"))
    assert kernel_cache_problem() is None


def test_what_cannot_be_written_is_named(environment, tmp_path):
    (tmp_path / "file").touch()
    environment.setenv("HOME", str(tmp_path / "file"))
    assert kernel_cache_problem().startswith(f"'{tmp_path}/file/.drjit' cannot be written, so")
    environment.setenv("DRJIT_CACHE_DIR", "/dev/null/cache")
    assert kernel_cache_problem().startswith("'/dev/null/cache' cannot be written")
    environment.delenv("DRJIT_CACHE_DIR")
    environment.delenv("HOME")
    assert kernel_cache_problem().startswith("HOME is not set")


def test_commands_tell(tmp_path):
    result = subprocess.run(
        [sys.executable, "-m", "gshell_mi.compare", str(tmp_path / "none")],
        text=True,
        capture_output=True,
        env=os.environ | {"HOME": "/dev/null", "DRJIT_CACHE_DIR": ""},
    )
    assert "warning: '/dev/null/.drjit' cannot be written" in result.stderr
    assert result.returncode == 2 and "Traceback" not in result.stderr
