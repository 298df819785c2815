"""Where Dr.Jit keeps compiled kernels, without which every run compiles them again."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def kernel_cache_problem() -> str | None:
    """One sentence if compiled kernels cannot be kept, which Dr.Jit does not say; None if they can.

    Dr.Jit has them in ``DRJIT_CACHE_DIR``, or in ``.drjit`` in the home folder.
    """
    if sys.platform == "win32":
        return None  # its place there is made by the system
    told, home = os.environ.get("DRJIT_CACHE_DIR"), os.environ.get("HOME")
    named = told or (f"{home}/.drjit" if home else None)
    if not named:
        where = "HOME is not set"
    else:
        folder = Path(named)
        there = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
        if there.is_dir() and os.access(there, os.W_OK | os.X_OK):
            return None
        where = f"'{folder}' cannot be written"
    return (
        f"{where}, so compiled kernels cannot be kept, and every run compiles them again, for most of a "
        f"minute; set DRJIT_CACHE_DIR to a folder that can be written."
    )
