"""What is free: by Linux, by a container's limit, by nvidia-smi."""

import os
from pathlib import Path

import numpy as np
import pytest

from gshell_mi import memory

MIB = 2**20


@pytest.fixture
def system(tmp_path, monkeypatch):
    """A machine with 8 GiB available and no limits."""
    (tmp_path / "meminfo").write_text("MemTotal: 16777216 kB\nMemFree: 1 kB\nMemAvailable: 8388608 kB\n")
    (tmp_path / "self").write_text("0::/user/fit\n")
    (tmp_path / "groups" / "user" / "fit").mkdir(parents=True)
    monkeypatch.setattr(memory, "_MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "_CGROUP_OF_SELF", tmp_path / "self")
    monkeypatch.setattr(memory, "_CGROUPS", tmp_path / "groups")
    return tmp_path


def limit(folder: Path, most: int | str, used: int, cached: int, version: int = 2) -> None:
    names = {
        1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        2: ("memory.max", "memory.current", "inactive_file"),
    }[version]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / names[0]).write_text(f"{most}\n")
    (folder / names[1]).write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon 5\n{names[2]} {cached}\n")


def test_available(system):
    assert memory.free_memory() == 8192 * MIB


@pytest.mark.parametrize("place", ["user/fit", "user", "."])
def test_a_container_has_less(system, place):
    limit(system / "groups" / place, 1000 * MIB, 700 * MIB, 200 * MIB)
    assert memory.free_memory() == 500 * MIB


def test_control_groups_of_version_1(system):
    (system / "self").write_text("5:cpu,cpuacct:/\n4:memory:/box\n0::/\n")
    limit(system / "groups" / "memory" / "box", 3000 * MIB, 1000 * MIB, 0, version=1)
    assert memory.free_memory() == 2000 * MIB


def test_no_limit_and_no_control_groups(system):
    limit(system / "groups" / "user", "max", 700 * MIB, 0)
    assert memory.free_memory() == 8192 * MIB
    (system / "self").unlink()
    assert memory.free_memory() == 8192 * MIB


def test_a_system_that_does_not_tell(system):
    (system / "meminfo").unlink()
    assert memory.free_memory() is None
    memory.require(2**60, None, "Anything", "nothing to mend")


def test_gpu(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert memory.free_gpu_memory() is None
    program = tmp_path / "nvidia-smi"
    program.write_text('#!/bin/sh\n[ "$1" = --id=3 ] && echo 79018 || { echo "No devices found"; exit 6; }\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}/bin{os.pathsep}/usr/bin")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,4")
    assert memory.free_gpu_memory() == 79018 * MIB
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    assert memory.free_gpu_memory() is None


def test_peak_grows_with_what_is_taken():
    before = memory.peak_memory()
    block = np.ones(before + 64 * MIB, np.uint8)
    assert memory.peak_memory() >= block.nbytes
