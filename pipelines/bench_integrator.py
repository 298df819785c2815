"""Times ``gshell_path`` against Mitsuba's ``prb`` and ``prb_projective``, and measures its noise.

    python pipelines/bench_integrator.py [--faces 4000 80000] [--repeats 12] [--depth 3]

One forward and one reverse pass per repeat, 256² pixels by default, 16 spp, an open shirt extracted from a
lattice with about the given number of faces, under an environment. The contestants take turns in one process
and the least time of each counts: processor time of all threads, which other processes disturb least (the
time on the clock is shown beside it). "std" is the standard deviation over seeds of the derivative of a
weighted sum of the image's colours with respect to a translation. ``prb_projective`` runs with sppc = sppp =
16 and sppi = 0.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from gshell_mi.extraction import extract
from gshell_mi.lattice import make_lattice
from pipelines import gradient_scenes
from pipelines.bench_extract import shirt as shirt_fields


def shirt(faces):
    """An open shirt, extracted from fields on a lattice fine enough for about that many faces."""
    cells, count = 32, 0
    for _ in range(3):
        lattice = make_lattice("tet", cells)
        sdf, msdf = shirt_fields(lattice.points(mi.Float))
        mesh = extract(lattice, sdf, msdf)
        count = mesh.face_count
        cells = max(8, round(cells * np.sqrt(faces / count)))
    v, f = np.array(mesh.vertices).T, np.array(mesh.faces).T
    return 1.3 * v[:, [0, 2, 1]] * np.array([1, 1, -1]), f


def contestants(depth):
    shared = {"max_depth": depth, "hide_emitters": True}
    ours = {"type": "gshell_path", **shared}
    return {
        "prb": {"type": "prb", **shared},
        **{f"gshell_path, reparam_depth {k}": {**ours, "reparam_depth": k} for k in range(1, depth + 1)},
        "prb_projective": {"type": "prb_projective", "sppc": 16, "sppp": 16, "sppi": 0, **shared},
    }


def step(mover, integrator, seed, weights):
    """Processor time, time and derivative of one rendering with its gradient."""
    t = mi.Float(0)
    dr.enable_grad(t)
    mover.to(t)
    dr.eval(mover.params[mover.key])
    dr.sync_thread()
    start, work = time.perf_counter(), time.process_time()
    image = mi.render(mover.scene, mover.params, integrator=integrator, spp=16, seed=seed)
    dr.backward(dr.sum(image[:, :, :3] * weights))
    dr.eval(dr.grad(t))
    dr.sync_thread()
    return time.process_time() - work, time.perf_counter() - start, float(dr.grad(t)[0])


def run(faces, resolution, depth, repeats):
    def build(pixels):
        v, f = shirt(faces)
        return (
            gradient_scenes.load(
                gradient_scenes.camera(pixels, (1.5, 1.5, 4)),
                gradient_scenes.sky(),
                gradient_scenes.make_mesh("subject", v, f),
            ),
            gradient_scenes.translation(v, (1, 0, 0)),
        )

    mover = gradient_scenes.Mover(gradient_scenes.GradientScene("shirt", "", build), resolution)
    count = dr.width(mover.params["subject.faces"]) // 3
    weights = mi.TensorXf(gradient_scenes.image_weights(resolution))
    integrators = {name: mi.load_dict(options) for name, options in contestants(depth).items()}
    results = {name: [] for name in integrators}
    for seed in range(repeats + 2):
        for name, integrator in integrators.items():
            result = step(mover, integrator, seed, weights)
            if seed >= 2:  # the first two compile and warm up
                results[name].append(result)
    least = {name: min(work for work, _, _ in r) for name, r in results.items()}
    clock = {name: min(t for _, t, _ in r) for name, r in results.items()}
    values = {name: np.array([d for _, _, d in r]) for name, r in results.items()}
    ratio = {name: least[name] / least["prb"] for name in least}
    noise = {name: values[name].std(ddof=1) * np.sqrt(least[name]) for name in least}
    print(
        f"\n{count} faces, depth {depth}\n\n"
        "| integrator | processor s | s | ratio to prb | mean | std | std sqrt(processor s) |\n"
        "|---|---|---|---|---|---|---|"
    )
    for name, x in values.items():
        print(
            f"| {name} | {least[name]:.3f} | {clock[name]:.3f} | {ratio[name]:.2f} | {x.mean():.0f} "
            f"| {x.std(ddof=1):.0f} | {noise[name]:.0f} |",
            flush=True,
        )
    bar = 1.3 if count < 20_000 else 1.5
    for name, limit in (("gshell_path, reparam_depth 1", bar), ("gshell_path, reparam_depth 2", 3.0)):
        if name in ratio:
            print(
                f"\n{name}: time {ratio[name]:.2f} of prb ({'within' if ratio[name] <= limit else 'ABOVE'} "
                f"{limit}); noise prb_projective / ours {noise['prb_projective'] / noise[name]:.1f}"
            )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--faces",
        type=int,
        nargs="*",
        default=[4000, 80000],
        help="approximate numbers of faces (default 4000 80000)",
    )
    parser.add_argument("--resolution", type=int, default=256, help="pixels per side (default 256)")
    parser.add_argument("--depth", type=int, default=3, help="max_depth (default 3)")
    parser.add_argument("--repeats", type=int, default=12, help="seeds per contestant (default 12)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default llvm_ad_rgb)")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    mi.set_log_level(mi.LogLevel.Error)
    for faces in arguments.faces:
        run(faces, arguments.resolution, arguments.depth, arguments.repeats)


if __name__ == "__main__":
    main()
