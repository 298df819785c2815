"""Times the extraction against ``skimage.measure.marching_cubes``, on one thread and in one process.

    python pipelines/bench_extract.py [--grids tet cube] [--resolutions 64 128 256] [--repeats 7]

The surface is a shirt: a torso and two sleeves, open at neck, hem and wrists. Every repeat gets new arrays
(copies of the fields), so that nothing is reused but compiled kernels; the contestants take turns, and the
least time of each counts. Marching cubes makes the closed template only, of float32 values in the same
order; it has no derivatives. ``backward`` is the gradient of a smooth function of vertices and mSDF with
respect to all fields.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time
from collections.abc import Callable
from functools import partial

import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np
from skimage.measure import marching_cubes

from gshell_mi.extraction import extract
from gshell_mi.lattice import GRIDS, Lattice, make_lattice


def shirt(lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance (approximate) of a shirt-like solid and the mSDF that opens its four ends."""
    p = lattice.points(llvm.Float)
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
    return sdf.numpy(), msdf.numpy()


def seconds(action: Callable[[], float], best: dict[str, float], name: str) -> None:
    best[name] = min(best.get(name, np.inf), action())


def run(resolution: int, grids: list[str], repeats: int) -> dict[str, float]:
    """Least times in seconds by name."""
    lattice = make_lattice("tet", resolution)  # all kinds have the same vertices
    sdf, msdf = shirt(lattice)
    deform = np.random.default_rng(0).uniform(-0.5, 0.5, 3 * lattice.vertex_count).astype(np.float32)
    volume = sdf.reshape((lattice.stride,) * 3)

    def scikit_image() -> float:
        field = volume.copy()
        start = time.perf_counter()
        marching_cubes(field, 0.0)
        return time.perf_counter() - start

    def ours(grid: str, arrays: tuple[np.ndarray, ...], backward: bool) -> float:
        fields = [llvm.Float(a) for a in arrays]
        if backward:
            dr.enable_grad(fields)
        dr.eval(fields)
        dr.sync_thread()
        start = time.perf_counter()
        mesh = extract(make_lattice(grid, resolution), *fields)
        if backward:
            dr.backward(dr.sum(dr.squared_norm(mesh.vertices)) + dr.sum(mesh.msdf))
            dr.eval([dr.grad(f) for f in fields])
        dr.sync_thread()
        return time.perf_counter() - start

    best: dict[str, float] = {}
    for _ in range(repeats):
        seconds(scikit_image, best, "marching cubes")
        for grid in grids:
            for label, arrays in (("sdf, msdf", (sdf, msdf)), ("sdf, msdf, deform", (sdf, msdf, deform))):
                for what, backward in (("forward", False), ("forward + backward", True)):
                    action = partial(ours, grid, arrays, backward)
                    seconds(action, best, f"{grid}: {label}: {what}")
    cubes = marching_cubes(volume, 0.0)[1]
    print(f"\n{resolution}^3 cells: marching cubes has {len(cubes)} triangles")
    for grid in grids:
        mesh = extract(make_lattice(grid, resolution), llvm.Float(sdf), llvm.Float(msdf))
        print(f"  {grid}: {mesh.face_count} triangles cut, {mesh.vertex_count} vertices")
    for name, value in best.items():
        print(f"  {name:40s} {value * 1e3:8.2f} ms   ratio {value / best['marching cubes']:5.2f}")
    return best


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--resolutions", type=int, nargs="+", default=[64, 128, 256], help="cells per side")
    parser.add_argument("--grids", nargs="+", default=list(GRIDS), choices=GRIDS, help="kinds of lattices")
    parser.add_argument("--repeats", type=int, default=7, help="runs of which the fastest counts")
    arguments = parser.parse_args()
    dr.set_thread_count(1)  # the calling thread is that one: there are no workers
    print(f"Dr.Jit {dr.__version__}, threads: {dr.thread_count()}")
    for resolution in arguments.resolutions:
        run(resolution, arguments.grids, arguments.repeats)


if __name__ == "__main__":
    main()
