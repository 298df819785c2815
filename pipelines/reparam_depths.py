"""What ``reparam_depth`` 1, 2 and 3 of ``gshell_path`` miss and cost on the meshes of ``scenes/``.

    python pipelines/reparam_depths.py [MESH ...] [--depths 2 3] [--resolution 48] [--seconds 20]

Each mesh is scaled about its centre under an environment map. The derivative of a smoothly weighted sum of
the image's colours is compared with finite differences of Mitsuba's ``path``
(``pipelines/surface_differences.py``). Prints the rows of a table for ``pipelines/gradients_notes.md``:
figures after ± are one standard error, "time" is the processor time of a forward derivative in units of that
with ``reparam_depth`` 1.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

sys.path.insert(0, str(Path(__file__).parents[1]))

import gshell_mi  # noqa: F401  (registers the plugins when the variant is set)
from pipelines import gradient_scenes
from pipelines.surface_differences import SurfaceImage
from pipelines.validate_gradients import FINE, agree, mean_and_error, repeat

MESHES = ("bowl", "chair", "skirt", "tshirt")
SPP, POINTS = 32, 200_000


def scaled_mesh(name: str, depth: int) -> gradient_scenes.GradientScene:
    """The true mesh of ``scenes/NAME``, to be scaled about its centre, 2.4 units across."""
    mesh = trimesh.load(gradient_scenes.ROOT / "scenes" / name / "truth.ply", process=False)
    vertices = np.array(mesh.vertices) - np.mean(mesh.bounds, axis=0)
    vertices *= 1.2 / np.abs(vertices).max()

    def build(resolution):
        subject = gradient_scenes.make_mesh("subject", vertices, np.array(mesh.faces))
        sensor = gradient_scenes.camera(resolution, (1.5, 1.5, 4))
        return gradient_scenes.load(sensor, gradient_scenes.sky(), subject), vertices

    return gradient_scenes.GradientScene(name, "scaled", build, depth)


def measure(case: gradient_scenes.GradientScene, resolution: int, seconds: float) -> list[str]:
    """One row per ``reparam_depth``."""
    mover, weights = gradient_scenes.Mover(case, resolution), gradient_scenes.image_weights(resolution)

    def figure(image_of_seed, least):
        values = []
        repeat(
            lambda seed: float((image_of_seed(seed)[..., :3] * weights).sum()), values, FINE, seconds, least
        )
        return mean_and_error(values), len(values)

    truth, _ = figure(lambda seed: SurfaceImage(mover, case, POINTS, seed).difference(case.step), 6)
    rows, unit = [], None
    for reparam_depth in range(1, case.depth + 1):
        integrator = mi.load_dict(
            {
                "type": "gshell_path",
                "max_depth": case.depth,
                "hide_emitters": True,
                "reparam_depth": reparam_depth,
            }
        )

        def forward(seed, integrator=integrator):
            return gradient_scenes.forward_image(mover, integrator, SPP, seed)

        forward(0)  # compiles
        begin = time.process_time()
        found, count = figure(forward, 8)
        each = (time.process_time() - begin) / count
        unit = unit or each
        rows.append(
            f"| {case.name} | {case.depth} | {truth[0]:.0f} ± {truth[1]:.0f} | {reparam_depth} | "
            f"{found[0]:.0f} ± {found[1]:.0f} | {100 * (found[0] / truth[0] - 1):+.1f} % | "
            f"{'yes' if agree(truth, found) else '**no**'} | {each / unit:.2f} |"
        )
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("meshes", nargs="*", help=f"folders of scenes/ (default {' '.join(MESHES)})")
    parser.add_argument("--depths", nargs="*", type=int, default=[2, 3], help="max_depth (default 2 3)")
    parser.add_argument("--resolution", type=int, default=48, help="pixels per side (default 48)")
    parser.add_argument(
        "--seconds", type=float, default=20, help="greatest processor time of a figure (default 20)"
    )
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default llvm_ad_rgb)")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    mi.set_log_level(mi.LogLevel.Error)
    print("| mesh | depth | FD | reparam_depth | gshell_path | bias | right | time |\n" + "|---" * 8 + "|")
    for name in arguments.meshes or MESHES:
        for depth in arguments.depths:
            measure(scaled_mesh(name, depth), arguments.resolution, arguments.seconds)


if __name__ == "__main__":
    main()
