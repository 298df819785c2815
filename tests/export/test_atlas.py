"""UV atlases of objects in any units."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gshell_mi.export import atlas
from gshell_mi.export.atlas import unwrap

BALL = trimesh.creation.icosphere(subdivisions=4)  # 5120 faces


@pytest.mark.parametrize("scale", [1e-8, 1e-3, 1e5])
def test_units_do_not_matter(scale):
    """xatlas takes faces of less than 1e-7 square units for empty."""
    expected = unwrap(BALL.vertices, BALL.faces)
    found = unwrap(scale * BALL.vertices + 10 * scale, BALL.faces)
    assert found is not None and found.charts == expected.charts < 20
    np.testing.assert_allclose(found.uv, expected.uv, atol=0.02)


@pytest.mark.skipif(sys.platform == "win32", reason="there the limit is one of the clock")
def test_the_time_limit_is_of_the_processors(tmp_path):
    """Waiting costs nothing, computing does."""
    for work, code in (("time.sleep(2.5)", 0), ("while True: pass", -signal.SIGXCPU)):
        lines = "import time", "class Atlas:", "  def add_mesh(*_):", f"    {work}", "    raise SystemExit"
        (tmp_path / "xatlas.py").write_text("\n".join(lines))
        np.savez(tmp_path / "mesh.npz", vertices=np.zeros((0, 3)), faces=np.zeros((0, 3)))
        script = Path(atlas.__file__).with_name("_unwrap.py")
        command = [sys.executable, str(script), str(tmp_path / "mesh.npz"), str(tmp_path / "atlas.npz"), "1"]
        found = subprocess.run(
            command, env=os.environ | {"PYTHONPATH": str(tmp_path)}, check=False, timeout=60
        )
        assert found.returncode == code
