"""Every test runs on one Mitsuba variant, chosen with ``--variant`` (default ``llvm_ad_rgb``)."""

import os
import re
from importlib.util import find_spec
from pathlib import Path

# BLAS threads and Dr.Jit's thread pool fight for the same cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import mitsuba as mi
import pytest

# Modules that cannot be imported without the extra "generate": their own tests say that they are skipped.
collect_ignore = (
    []
    if find_spec("torch") and find_spec("monai")
    else [
        "gshell_mi/generation/models",
        *(
            str(path)
            for path in Path(__file__).parent.glob("gshell_mi/generation/*.py")
            if re.search(r"^(from|import) (torch|monai)\b", path.read_text(encoding="utf-8"), re.MULTILINE)
        ),
    ]
)


def pytest_addoption(parser):
    parser.addoption("--variant", default="llvm_ad_rgb", help="Mitsuba variant to test on")


def pytest_configure(config):
    mi.set_variant(config.getoption("--variant"))


@pytest.fixture(scope="session")
def variant(request) -> str:
    return request.config.getoption("--variant")


@pytest.fixture(scope="session")
def scenes_dir() -> Path:
    """The scenes folder of this repository."""
    return Path(__file__).parent / "scenes"


@pytest.fixture(scope="session")
def ball():
    """A unit sphere of 2562 vertices."""
    import trimesh

    return trimesh.creation.icosphere(4)


@pytest.fixture(scope="session")
def bowl_scene(tmp_path_factory) -> Path:
    """A small fit scene with targets, an open half-sphere; to be copied before it is changed."""
    from bowl import write_fit_scene

    return write_fit_scene(tmp_path_factory.mktemp("bowl"))
