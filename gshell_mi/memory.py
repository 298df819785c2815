"""How much memory this machine has left, and how much this process has taken."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi

from .errors import UserError

_MEMINFO = Path("/proc/meminfo")
_CGROUP_OF_SELF = Path("/proc/self/cgroup")
_CGROUPS = Path("/sys/fs/cgroup")

GIB = 2**30

#: Bytes per sample of a rendered image, and the longest paths that Mitsuba's integers count.
PER_SAMPLE, LONGEST_PATH = 50, 2**31 - 1


class _Interface(NamedTuple):
    """Where a version of Linux's control groups tells what."""

    folder: str
    limit: str
    used: str
    cached: str


_VERSION_1 = _Interface("memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_VERSION_2 = _Interface("", "memory.max", "memory.current", "inactive_file")


def free_memory() -> int | None:
    """Bytes that this process can still take without swapping: those that Linux calls available, or what the
    control group (a container's limit) leaves, whichever is less. None where the system does not tell."""
    found = [left for left in (_available(), *_left_in_control_groups()) if left is not None]
    return min(found, default=None)


def free_gpu_memory() -> int | None:
    """Bytes free on the first visible NVIDIA GPU, as nvidia-smi tells; None if it does not."""
    first = os.environ.get("CUDA_VISIBLE_DEVICES", "0").partition(",")[0] or "0"
    command = ["nvidia-smi", f"--id={first}", "--query-gpu=memory.free", "--format=csv,noheader,nounits"]
    try:
        told = subprocess.run(command, capture_output=True, text=True, check=True, timeout=20).stdout
        return int(told.split()[0]) * 2**20
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return None


def free_memory_of_variant() -> int | None:
    """Bytes free where the arrays of the current Mitsuba variant live."""
    return free_gpu_memory() if (mi.variant() or "").startswith("cuda") else free_memory()


def peak_memory() -> int:
    """Bytes of main memory that this process has held at most since it began."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def require(needed: int, free: int | None, what: str, cure: str) -> None:
    """Refuses what cannot fit.

    >>> require(3 * GIB, 2 * GIB, "A lattice of 400 cells per side", "lower its resolution")
    Traceback (most recent call last):
        ...
    gshell_mi.errors.UserError: A lattice of 400 cells per side needs about 3.0 GiB of memory, and 2.0 GiB \
are free; lower its resolution.
    """
    if free is not None and needed > free:
        raise UserError(
            f"{what} needs about {needed / GIB:.1f} GiB of memory, and {free / GIB:.1f} GiB are free; {cure}."
        )


def require_for_image(width: int, height: int, spp: int, what: str, cure: str) -> None:
    """Refuses an image whose samples do not fit into the memory of the current variant, as ``require``."""
    require(PER_SAMPLE * width * height * spp, free_memory_of_variant(), what, cure)


def _available() -> int | None:
    try:
        for line in _MEMINFO.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    return None


def _left_in_control_groups() -> list[int]:
    """What each control group above this process leaves of its limit."""
    try:
        groups = [line.split(":", 2) for line in _CGROUP_OF_SELF.read_text().splitlines()]
    except OSError:
        return []
    found = []
    for _, controllers, path in groups:
        if controllers and "memory" not in controllers.split(","):
            continue
        version = _VERSION_1 if controllers else _VERSION_2
        top = _CGROUPS / version.folder
        own = top / path.lstrip("/")
        for folder in (own, *(parent for parent in own.parents if parent.is_relative_to(top))):
            left = _left(folder, version)
            if left is not None:
                found.append(left)
    return found


def _left(folder: Path, version: _Interface) -> int | None:
    try:
        limit, used = ((folder / name).read_text().strip() for name in (version.limit, version.used))
        counts = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
    except OSError:
        return None
    if limit == "max":
        return None
    # Cached files count as used, but make room.
    return max(0, int(limit) - int(used) + int(counts.get(version.cached, 0)))
