import re
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "pipelines" / "bench_extract.py"


def test_prints_the_ratio_of_every_contestant():
    command = [sys.executable, SCRIPT, "--resolutions", "8", "12", "--repeats", "1"]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    heading = r"^(\d+)\^3 cells: (\d+) triangles cut; marching cubes has (\d+)$"
    found = re.findall(heading, output, re.MULTILINE)
    assert [resolution for resolution, *_ in found] == ["8", "12"]
    assert all(int(ours) > 0 and int(cubes) > 0 for _, ours, cubes in found)
    rows = re.findall(r"^  (\S.*?) +([\d.]+) ms +ratio +([\d.]+)$", output, re.MULTILINE)
    ours = [f"{fields}: {what}" for fields in ("sdf, msdf", "sdf, msdf, deform")
            for what in ("forward", "forward + backward")]
    assert sorted(name for name, *_ in rows) == sorted(2 * ["marching cubes", *ours])
    assert all(float(ratio) == 1 for name, _, ratio in rows if name == "marching cubes")
