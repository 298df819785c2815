import subprocess
import sys
from pathlib import Path

from gshell_mi.lattice import GRIDS

SCRIPT = Path(__file__).parents[2] / "pipelines" / "compare_grids.py"


def test_prints_a_row_per_grid():
    command = [sys.executable, SCRIPT, "--vertices", "1500", "--repeats", "2"]
    rows = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[2:]
    table = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [row[0] for row in table] == [f"`{grid}`" for grid in GRIDS]
    for row in table:
        vertices, distance, angle, ratio = (float(cell) for cell in row[2:6])
        assert abs(vertices - 1500) < 200 and 0 < distance < 10 and 0 < angle < 10 and 1 <= ratio < 5
