import re
import subprocess
import sys
from pathlib import Path

from gshell_mi.lattice import GRIDS, make_lattice

SCRIPT = Path(__file__).parents[2] / "pipelines" / "bench_extract.py"


def test_prints_the_ratio_of_every_contestant():
    command = [sys.executable, SCRIPT, "--resolutions", "8", "12", "--repeats", "1", "--band", "16", "64"]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    heading = r"^(\d+)\^3 cells: marching cubes has (\d+) triangles$"
    found = re.findall(heading, output, re.MULTILINE)
    assert [resolution for resolution, _ in found] == ["8", "12"]
    assert all(int(cubes) > 0 for _, cubes in found)
    counts = re.findall(r"^  (\w+): (\d+) triangles cut, \d+ vertices$", output, re.MULTILINE)
    assert [grid for grid, _ in counts] == 2 * list(GRIDS) and all(int(n) > 0 for _, n in counts)
    rows = re.findall(r"^  (\S.*?) +([\d.]+) ms +ratio +([\d.]+)$", output, re.MULTILINE)
    ours = [
        f"{grid}: {fields}: {what}"
        for grid in GRIDS
        for fields in ("sdf, msdf", "sdf, msdf, deform")
        for what in ("forward", "forward + backward")
    ]
    assert sorted(name for name, *_ in rows) == sorted(2 * ["marching cubes", *ours])
    assert all(float(ratio) == 1 for name, _, ratio in rows if name == "marching cubes")
    exponents = re.findall(r"with the exponent -?[\d.]+ \((?:at most|above) 2\.2\)$", output, re.MULTILINE)
    banded = [grid for grid in GRIDS if make_lattice(grid, 1).fits_in_blocks]
    assert len(exponents) == 2 * len(banded)
    row = r"\^3 in a band of [\d.]+ of the cells: forward [\d.]+ ms, forward \+ backward [\d.]+ ms$"
    assert len(re.findall(row, output, re.MULTILINE)) == 2 * len(banded)
    peaks = re.findall(r"\^3: peak memory (\d+) MiB$", output, re.MULTILINE)
    assert len(peaks) == 2 * len(banded) and any(int(peak) > 0 for peak in peaks)
