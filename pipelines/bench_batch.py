"""Times many small fits as a batch on a Ray cluster against a shell loop, and loses a machine on the way.

Fits of one small scene, one per seed, run three times: the first ``--timed`` from ``xargs``, as many at once
as there are nodes; the same as a batch on a cluster of this machine with as many places; and all ``--fits``
as a batch on a cluster of ``--nodes`` nodes with a place each, one of which is killed when half are done.
Printed are the seconds, their ratio, and what became of the fits. Exit code 1 if a result is missing or is
not as good as the loop's, or if a fit that had come to its end was run again. Nothing else should run: Ray's
workers give way to other processes.

    python pipelines/bench_batch.py [--fits 40] [--timed 40] [--nodes 2]

Needs ``pip install 'gshell_mi[ray]'``.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import mitsuba as mi  # noqa: E402
import ray  # noqa: E402
from bowl import CLOSED, SHORT, write_fit_scene  # noqa: E402
from ray.cluster_utils import Cluster  # noqa: E402

#: Options that leave hardly more of a fit than its start, where a batch could lose most.
TINY = (
    "--cavities.iterations",
    "0",
    "--refinement.iterations",
    "0",
    "--radiance.batch",
    "1024",
    "--iterations",
    "3",
)

#: Runs of one fit on two threads differ by their sums' order, after so few steps by much less than this (dB).
TOLERANCE = 0.5


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fits", type=int, default=40)
    parser.add_argument("--timed", type=int, default=40)
    parser.add_argument("--nodes", type=int, default=2)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        return measured(Path(folder), given.fits, given.timed, given.nodes)


def measured(folder: Path, fits: int, timed: int, nodes: int) -> int:
    mi.set_variant("llvm_ad_rgb")
    options = [str(write_fit_scene(folder)), *SHORT, *CLOSED, *TINY, "--quiet"]
    loop, looped = in_a_loop(options, folder / "loop", timed, nodes), scores(folder / "loop", timed)
    print(f"shell loop: {loop:.1f} s, {len(looped)} of {timed} fits", flush=True)

    jobs = write_jobs(folder / "timed", options, timed)
    batch = in_a_batch(jobs, folder / "batch", "--cpus", str(nodes))
    batched = scores(folder / "batch" / "jobs", timed, "out")
    print(f"batch: {batch:.1f} s, {len(batched)} of {timed} fits, ratio {batch / loop:.3f}", flush=True)

    jobs = write_jobs(folder / "all", options, fits)
    lost, again = with_a_lost_node(jobs, folder / "lost", fits, nodes)
    surviving = scores(folder / "lost" / "jobs", fits, "out")
    print(
        f"batch that loses one of {nodes} nodes half-way: {lost:.1f} s, {len(surviving)} of {fits} fits; "
        f"run again after their end: {again}"
    )
    worst = max(
        abs(found[name] - looped[name])
        for found in (batched, surviving)
        for name in found.keys() & looped.keys()
    )
    print(f"PSNR: at most {worst:.2f} dB from the loop's")
    whole = len(looped) == len(batched) == timed and len(surviving) == fits
    return 0 if whole and worst < TOLERANCE and not again else 1


def write_jobs(path: Path, options: list[str], fits: int) -> Path:
    lines = (
        json.dumps({"name": name, "command": "fit", "arguments": [*options, "--seed", str(seed)]})
        for seed, name in enumerate(names(fits))
    )
    path.write_text("\n".join(lines))
    return path


def names(fits: int) -> list[str]:
    return [f"fit{seed:03}" for seed in range(fits)]


def in_a_loop(options: list[str], output: Path, fits: int, at_once: int) -> float:
    """Seconds."""
    output.mkdir()
    fit = shlex.join([sys.executable, "-m", "gshell_mi.fit", *options])
    each = f"{fit} -o {shlex.quote(str(output))}/$1 --seed $2 >/dev/null 2>&1"
    lines = "".join(f"{name} {seed}\n" for seed, name in enumerate(names(fits)))
    started = time.perf_counter()
    command = ["xargs", "-P", str(at_once), "-L", "1", "sh", "-c", each, "sh"]
    subprocess.run(command, input=lines, text=True, cwd=ROOT, check=True)
    return time.perf_counter() - started


def in_a_batch(jobs: Path, output: Path, *options: str) -> float:
    """Seconds."""
    started = time.perf_counter()
    subprocess.run(batch_command(jobs, output, *options), cwd=ROOT, check=True)
    return time.perf_counter() - started


def with_a_lost_node(jobs: Path, output: Path, fits: int, nodes: int) -> tuple[float, int]:
    """Seconds, and how many fits were run again although they had come to their end."""
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    others = [cluster.add_node(num_cpus=1) for _ in range(nodes - 1)]
    cluster.wait_for_nodes()
    ended: dict[Path, int] = {}
    again = 0
    started = time.perf_counter()
    process = subprocess.Popen(batch_command(jobs, output, "--address", cluster.address), cwd=ROOT)
    while process.poll() is None:
        for path in (output / "jobs").glob("*/job.json"):
            written = path.stat().st_mtime_ns
            again += ended.setdefault(path, written) != written
            ended[path] = written
        if others and 2 * len(ended) >= fits:
            cluster.remove_node(others.pop(), allow_graceful=False)
        time.sleep(0.1)
    seconds = time.perf_counter() - started
    cluster.shutdown()
    ray.shutdown()
    return seconds, again


def batch_command(jobs: Path, output: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "gshell_mi.batch", str(jobs), "-o", str(output), "--quiet", *options]


def scores(output: Path, fits: int, below: str = "") -> dict[str, float]:
    """PSNR of the fits that are whole."""
    found = {}
    for name in names(fits):
        folder = output / name / below
        if (folder / "mesh.ply").is_file() and (folder / "metrics.json").is_file():
            found[name] = json.loads((folder / "metrics.json").read_text())["psnr_training"]
    return found


if __name__ == "__main__":
    sys.exit(main())
