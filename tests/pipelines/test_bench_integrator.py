import re
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "pipelines" / "bench_integrator.py"


def test_prints_time_and_noise_of_every_contestant():
    command = [
        sys.executable,
        SCRIPT,
        "--faces",
        "60",
        "--resolution",
        "16",
        "--repeats",
        "2",
        "--depth",
        "2",
    ]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    rows = re.findall(
        r"^\| (\w.*?) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| (-?\d+) \| (\d+) \| (\d+) \|$",
        output,
        re.MULTILINE,
    )
    ours = [f"gshell_path, reparam_depth {depth}" for depth in (1, 2)]
    assert [name for name, *_ in rows] == ["prb", *ours, "prb_projective"]
    assert all(float(work) > 0 and int(deviation) > 0 for _, work, _, _, _, deviation, _ in rows)
    assert float(rows[0][3]) == 1
    verdicts = re.findall(r"^(.*): time [\d.]+ of prb \((?:within|ABOVE) [\d.]+\)", output, re.MULTILINE)
    assert verdicts == ours
