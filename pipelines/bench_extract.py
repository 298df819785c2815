"""Times the extraction against ``skimage.measure.marching_cubes``, on one thread and in one process.

    python pipelines/bench_extract.py [--grids tet cube] [--resolutions 64 128 256] [--repeats 7]

The surface is a shirt: a torso and two sleeves, open at neck, hem and wrists. Every repeat gets new arrays
(copies of the fields), so that nothing is reused but compiled kernels; the contestants take turns, and the
least time of each counts: processor time, which other programs disturb less than that of a clock. Marching
cubes makes the closed template only, of float32 values in the same order; it has no derivatives.
``backward`` is the gradient of a smooth function of vertices and mSDF with respect to all fields. At the end,
the same with fields stored in blocks around the surface (a narrow band): times, with the test whether the
blocks still hold the surface, the exponents with which they grow, and peak memory: all that the process
needs for fields, gradients, blocks and mesh.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np
from skimage.measure import marching_cubes

from gshell_mi.block_lattice import BlockLattice
from gshell_mi.extraction import extract
from gshell_mi.lattice import GRIDS, make_lattice

#: Bars: exponent of the times, and peak memory in MiB by resolution.
EXPONENT, MEMORY = 2.2, {256: 512, 512: 2048}


def shirt(p: llvm.Array3f) -> tuple[llvm.Float, llvm.Float]:
    """Signed distance (approximate) of a shirt-like solid and the mSDF that opens its four ends."""
    x, y, z = dr.abs(p.x), p.y, p.z

    def capsule(a: tuple[float, float], b: tuple[float, float], radius: float):
        """In the plane x, z, with a section flattened along y."""
        ux, uz = b[0] - a[0], b[1] - a[1]
        t = dr.clip(((x - a[0]) * ux + (z - a[1]) * uz) / (ux * ux + uz * uz), 0, 1)
        dx, dz = x - a[0] - t * ux, z - a[1] - t * uz
        return dr.sqrt(dx * dx + dz * dz + dr.square(1.7 * y)) - radius

    folds = 0.012 * dr.sin(23 * p.x + 5 * z) * dr.cos(7 * z)
    torso = capsule((0.0, 0.25), (0.0, -0.75), 0.38)
    sleeve = capsule((0.2, 0.35), (0.75, -0.05), 0.16)
    sdf = dr.minimum(torso, sleeve) + folds
    hem, wrist, neck = z + 0.7, 0.95 - x - 0.7 * z - 0.25, 0.48 - z + 0.5 * dr.square(p.x)
    msdf = dr.minimum(dr.minimum(hem, wrist), neck)
    return sdf, msdf


def seconds(action: Callable[[], float], best: dict[str, float], name: str) -> None:
    best[name] = min(best.get(name, np.inf), action())


def run(resolution: int, grids: list[str], repeats: int) -> dict[str, float]:
    """Least times in seconds by name."""
    fields = {}
    for grid in {"tet", *grids}:
        lattice = make_lattice(grid, resolution)
        sdf, msdf = (field.numpy() for field in shirt(lattice.points(llvm.Float)))
        offsets = np.random.default_rng(0).uniform(-0.5, 0.5, 3 * lattice.vertex_count)
        fields[grid] = sdf, msdf, offsets.astype(np.float32)
    volume = fields["tet"][0].reshape((resolution + 1,) * 3)

    def scikit_image() -> float:
        field = volume.copy()
        start = time.process_time()
        marching_cubes(field, 0.0)
        return time.process_time() - start

    def ours(grid: str, arrays: tuple[np.ndarray, ...], backward: bool) -> float:
        fields = [llvm.Float(a) for a in arrays]
        if backward:
            dr.enable_grad(fields)
        dr.eval(fields)
        dr.sync_thread()
        start = time.process_time()
        mesh = extract(make_lattice(grid, resolution), *fields)
        if backward:
            dr.backward(dr.sum(dr.squared_norm(mesh.vertices)) + dr.sum(mesh.msdf))
            dr.eval([dr.grad(f) for f in fields])
        dr.sync_thread()
        return time.process_time() - start

    best: dict[str, float] = {}
    for _ in range(repeats):
        seconds(scikit_image, best, "marching cubes")
        for grid in grids:
            for label, arrays in (("sdf, msdf", fields[grid][:2]), ("sdf, msdf, deform", fields[grid])):
                for what, backward in (("forward", False), ("forward + backward", True)):
                    action = partial(ours, grid, arrays, backward)
                    seconds(action, best, f"{grid}: {label}: {what}")
    cubes = marching_cubes(volume, 0.0)[1]
    print(f"\n{resolution}^3 cells: marching cubes has {len(cubes)} triangles")
    for grid in grids:
        mesh = extract(make_lattice(grid, resolution), *(llvm.Float(field) for field in fields[grid][:2]))
        print(f"  {grid}: {mesh.face_count} triangles cut, {mesh.vertex_count} vertices")
    for name, value in best.items():
        print(f"  {name:40s} {value * 1e3:8.2f} ms   ratio {value / best['marching cubes']:5.2f}")
    return best


def memory(name: str) -> float:
    """A figure of this process in MiB (Linux)."""
    return int(re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024


def run_banded(grid: str, resolution: int, repeats: int) -> dict[str, float]:
    """Least seconds and peak memory in MiB of extractions in blocks, by name."""
    best: dict[str, float] = {}
    results: dict[str, float] = {}

    def measure(resolution: int, repeats: int) -> None:
        blocks = BlockLattice.around(make_lattice(grid, resolution), lambda p: shirt(p)[0], llvm.Float)
        fields = shirt(blocks.points(llvm.Float))
        dr.eval(fields)
        dr.sync_thread()
        results["fraction"] = blocks.fraction
        for what in ("forward", "forward + backward"):

            def action(backward: bool = what != "forward") -> float:
                dr.disable_grad(fields)
                if backward:
                    dr.enable_grad(fields)
                start = time.process_time()
                mesh = extract(blocks, *fields)
                assert blocks.covers(mesh.cells)
                if backward:
                    dr.backward(dr.sum(dr.squared_norm(mesh.vertices)) + dr.sum(mesh.msdf))
                    dr.eval([dr.grad(f) for f in fields])
                dr.sync_thread()
                return time.process_time() - start

            dr.flush_malloc_cache()
            Path("/proc/self/clear_refs").write_text("5")  # resets the peak
            for _ in range(repeats):
                seconds(action, best, what)
            results[f"{what} MiB"] = memory("VmHWM") - before

    before = 0.0
    measure(32, 2)  # compiles
    dr.flush_malloc_cache()
    before = memory("VmRSS")
    best.clear()
    measure(resolution, repeats)
    return results | best


def print_banded(grid: str, resolutions: list[int], repeats: int) -> None:
    """One fresh process per resolution, as peak memory never falls."""
    found = []
    for resolution in resolutions:
        command = [sys.executable, __file__, "--banded", grid, str(resolution), str(repeats)]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        found.append(json.loads(output.splitlines()[-1]))
        row = ", ".join(f"{name} {value:.4g}" for name, value in found[-1].items())
        print(f"  {grid} {resolution}^3 in a band: {row}")
        if resolution in MEMORY:
            peak = found[-1]["forward + backward MiB"]
            print(f"  {grid}: peak memory {peak:.0f} MiB {verdict(peak, MEMORY[resolution])}")
    for what in ("forward", "forward + backward"):
        exponent = np.log(found[-1][what] / found[0][what]) / np.log(resolutions[-1] / resolutions[0])
        print(f"  {grid}: seconds of {what} grow with the exponent {exponent:.2f} "
              f"{verdict(exponent, EXPONENT)}")


def verdict(value: float, bar: float) -> str:
    return f"({'at most' if value <= bar else 'above'} {bar:g})"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--resolutions", type=int, nargs="+", default=[64, 128, 256], help="cells per side")
    parser.add_argument("--grids", nargs="+", default=list(GRIDS), choices=GRIDS, help="kinds of lattices")
    parser.add_argument("--repeats", type=int, default=7, help="runs of which the fastest counts")
    parser.add_argument("--band", type=int, nargs="+", default=[128, 256, 512], help="the same with a band")
    parser.add_argument("--banded", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    dr.set_thread_count(1)  # the calling thread is that one: there are no workers
    if arguments.banded:
        grid, resolution, repeats = arguments.banded
        print(json.dumps(run_banded(grid, int(resolution), int(repeats))))
        return
    print(f"Dr.Jit {dr.__version__}, threads: {dr.thread_count()}")
    for resolution in arguments.resolutions:
        run(resolution, arguments.grids, arguments.repeats)
    print()
    for grid in arguments.grids:
        if not make_lattice(grid, 1).fits_in_blocks:
            continue
        print_banded(grid, arguments.band, arguments.repeats)


if __name__ == "__main__":
    main()
