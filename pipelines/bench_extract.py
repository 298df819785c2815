"""Times the extraction against ``skimage.measure.marching_cubes``, on one thread and in one process.

    python pipelines/bench_extract.py [--grids tet cube] [--resolutions 64 128 256] [--repeats 7]

The surface is a shirt: a torso and two sleeves, open at neck, hem and wrists. Every repeat gets new arrays
(copies of the fields), so that nothing is reused but compiled kernels; the contestants take turns, and the
least time of each counts: processor time, which other programs disturb less than that of a clock. Marching
cubes makes the closed template only, of float32 values in the same order; it has no derivatives.
``backward`` is the gradient of a smooth function of vertices and mSDF with respect to all fields. At the end,
the same with fields stored in blocks around the surface (a narrow band): times, with the test whether the
blocks still hold the surface, and the exponents with which they grow. Here the resolutions take turns, as
in a fit, too, something else has been in the caches since the last extraction. Peak memory, of a process for
each resolution, is all that it needs for fields, gradients, blocks and mesh.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
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

from gshell_mi.extraction import extract
from gshell_mi.lattice import GRIDS, BlockLattice, make_lattice

#: Bars: exponent of the times, and peak memory in MiB by resolution.
EXPONENT, MEMORY = 2.2, {256: 512, 512: 2048}

#: Whether what is timed has a backward pass, by its name.
BACKWARD = {"forward": False, "forward + backward": True}

#: Resolution at which the kernels of a band are compiled.
_SMALL = 32


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
                for what, backward in BACKWARD.items():
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


class Banded:
    """Extractions in blocks at one resolution."""

    def __init__(self, grid: str, resolution: int):
        self.blocks = BlockLattice.around(make_lattice(grid, resolution), lambda p: shirt(p)[0], llvm.Float)
        self.fields = shirt(self.blocks.points(llvm.Float))
        dr.eval(self.fields)
        dr.sync_thread()

    def seconds(self, backward: bool) -> float:
        dr.disable_grad(self.fields)
        if backward:
            dr.enable_grad(self.fields)
        start = time.process_time()
        mesh = extract(self.blocks, *self.fields)
        assert self.blocks.covers(mesh.cells)
        if backward:
            dr.backward(dr.sum(dr.squared_norm(mesh.vertices)) + dr.sum(mesh.msdf))
            dr.eval([dr.grad(f) for f in self.fields])
        dr.sync_thread()
        return time.process_time() - start


def run_banded(grid: str, resolutions: list[int], repeats: int) -> None:
    """Prints least times by resolution, and the exponents from the first to the last."""
    bands = [Banded(grid, resolution) for resolution in resolutions]
    best: list[dict[str, float]] = [{} for _ in bands]
    for _ in range(repeats):
        for what, backward in BACKWARD.items():
            for band, times in zip(bands, best, strict=True):
                seconds(partial(band.seconds, backward), times, what)
    for resolution, band, times in zip(resolutions, bands, best, strict=True):
        row = ", ".join(f"{name} {value * 1e3:.1f} ms" for name, value in times.items())
        print(f"  {grid} {resolution}^3 in a band of {band.blocks.fraction:.3f} of the cells: {row}")
    for what in BACKWARD:
        exponent = np.log(best[-1][what] / best[0][what]) / np.log(resolutions[-1] / resolutions[0])
        print(
            f"  {grid}: seconds of {what} grow with the exponent {exponent:.2f} {verdict(exponent, EXPONENT)}"
        )


def peak_of_band(grid: str, resolution: int) -> float:
    """Peak memory in MiB of extractions in blocks, forward and backward, in a process of their own."""
    for backward in BACKWARD.values():
        Banded(grid, _SMALL).seconds(backward)  # compiles
    dr.flush_malloc_cache()
    before = memory("VmRSS")
    band = Banded(grid, resolution)
    dr.flush_malloc_cache()
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    for backward in BACKWARD.values():
        band.seconds(backward)
    return memory("VmHWM") - before


def print_banded(grid: str, resolutions: list[int], repeats: int) -> None:
    run_banded(grid, resolutions, repeats)
    for resolution in resolutions:
        # A fresh process, as peak memory never falls.
        command = [sys.executable, __file__, "--peak-of-band", grid, str(resolution)]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        peak = float(output.splitlines()[-1])
        bar = verdict(peak, MEMORY[resolution]) if resolution in MEMORY else ""
        print(f"  {grid} {resolution}^3: peak memory {peak:.0f} MiB {bar}".rstrip())


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
    parser.add_argument("--peak-of-band", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    dr.set_thread_count(1)  # the calling thread is that one: there are no workers
    if arguments.peak_of_band:
        grid, resolution = arguments.peak_of_band
        print(peak_of_band(grid, int(resolution)))
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
