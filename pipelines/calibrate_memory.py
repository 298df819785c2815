"""Compares the estimate of a fit's memory (gshell_mi/fit/memory.py) with what short fits of a scene take.

    python pipelines/calibrate_memory.py scenes/tshirt/reference.xml WORK [--cases 32:24:128 64:48:256 ...]

A case is RESOLUTION:VIEWS:PIXELS, cells per side, training views and their width and height. The fits go
through all stages with a few steps each, as peaks do not depend on how many there are. Prints a Markdown
table of what the fits' metrics.json say.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "pipelines"))

from scene_builder import files

CASES = ("32:24:128", "64:24:128", "64:48:256", "128:24:256", "64:12:800")
SHORT = (
    "--openings.iterations",
    "15",
    "--cavities.iterations",
    "10",
    "--refinement.iterations",
    "6",
    "--folds.iterations",
    "0",
    "--iterations",
    "12",
)


def write_case(reference: mi.Scene, work: Path, resolution: int, views: int, pixels: int) -> Path:
    """A fit scene with targets of few samples, rendered from ``reference``."""
    name = f"case_{resolution}_{views}_{pixels}"
    (work / name).mkdir(parents=True, exist_ok=True)
    files.SIZE = pixels
    box = reference.bbox()
    radius = np.linalg.norm(np.maximum(np.abs(box.min), np.abs(box.max)))
    distance = 1.04 * radius / np.sin(np.radians(files.FOV / 2))
    scene = work / f"{name}.xml"
    scene.write_text(
        files.scene_xml(
            f'<shape type="gshell" id="subject"><integer name="resolution" value="{resolution}"/></shape>\n'
            '<emitter type="constant" id="light"/>\n',
            *(
                files.sensor_xml(f"view_{index:03}", distance * direction)
                for index, direction in enumerate(files.fibonacci_sphere(views))
            ),
            spp=4,
        )
    )
    integrator = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    for sensor in mi.load_file(str(scene)).sensors():
        image = mi.render(reference, sensor=sensor, integrator=integrator, spp=4)
        mi.Bitmap(image).write(str(work / name / f"{sensor.id()}.exr"))
    return scene


def measure(scene: Path) -> dict:
    """The metrics of a short fit in a process of its own."""
    output = scene.with_name(f"{scene.stem}_fit")
    subprocess.run(
        [
            sys.executable,
            "-m",
            "gshell_mi.fit",
            str(scene),
            "-o",
            str(output),
            "--overwrite",
            "--quiet",
            *SHORT,
        ],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return json.loads((output / "metrics.json").read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("reference", type=Path, help="a stock scene: scenes/tshirt/reference.xml")
    parser.add_argument("work", type=Path, help="folder for scenes and fits")
    parser.add_argument("--cases", nargs="+", default=CASES, help="RESOLUTION:VIEWS:PIXELS each")
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    import gshell_mi  # noqa: F401 - registers the gshell shape

    reference = mi.load_file(str(given.reference))
    print("| cells | views | pixels | estimate (MiB) | peak (MiB) | ratio |\n|---|---|---|---|---|---|")
    for case in given.cases:
        resolution, views, pixels = map(int, case.split(":"))
        metrics = measure(write_case(reference, given.work, resolution, views, pixels))
        estimate, peak = metrics["estimated_memory_mib"], metrics["peak_memory_mib"]
        print(
            f"| {resolution} | {views} | {pixels}² | {estimate} | {peak} | {estimate / peak:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
