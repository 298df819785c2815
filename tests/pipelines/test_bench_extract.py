import re
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "pipelines" / "bench_extract.py"


def test_extraction_keeps_up_with_marching_cubes():
    """At 128^3 on one thread: forward no slower, forward and backward at most twice as long."""
    command = [sys.executable, SCRIPT, "--resolutions", "128", "--repeats", "5"]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    ratios = dict(re.findall(r"^  (\S.*?) +[\d.]+ ms +ratio +([\d.]+)$", output, re.MULTILINE))
    assert len(ratios) == 5 and float(ratios["marching cubes"]) == 1
    for fields in ("sdf, msdf", "sdf, msdf, deform"):
        assert float(ratios[f"{fields}: forward"]) <= 1
        assert float(ratios[f"{fields}: forward + backward"]) <= 2
