"""A figure of a fit: target, fit and bare mesh from a few views; back faces in orange as in the paper.

python pipelines/make_figure.py SCENE.xml OUT FIGURE.png [--views view_010 view_024 ...]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

from gshell_mi.doctor import ensure_variant
from gshell_mi.images import over_white, write_png

FRONT, BACK = (0.75, 0.78, 0.82), (0.90, 0.42, 0.10)


def bare_mesh(path: Path) -> mi.Scene:
    """The mesh alone under a soft key light."""
    sides = {
        side: {"type": "diffuse", "reflectance": {"type": "rgb", "value": color}}
        for side, color in (("front", FRONT), ("back", BACK))
    }
    return mi.load_dict(
        {
            "type": "scene",
            "mesh": {"type": "ply", "filename": str(path), "bsdf": {"type": "twosided", **sides}},
            "ambient": {"type": "constant", "radiance": 0.5},
            "key": {"type": "directional", "direction": [-0.4, -1.0, -0.6], "irradiance": 1.3},
        }
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="the fit scene, for its sensors")
    parser.add_argument("output", type=Path, help="the fit's folder")
    parser.add_argument("figure", type=Path, help="the PNG to write")
    parser.add_argument("--views", nargs="+", default=["view_010", "view_024", "view_040"], help="sensor ids")
    parser.add_argument("--spp", type=int, default=256, help="samples per pixel")
    given = parser.parse_args()
    ensure_variant()
    sensors = {sensor.id(): sensor for sensor in mi.load_file(str(given.scene)).sensors()}
    fitted, mesh = mi.load_file(str(given.output / "scene.xml")), bare_mesh(given.output / "mesh.ply")
    integrator = mi.load_dict({"type": "path", "max_depth": 5, "hide_emitters": True})
    rows = []
    for name in given.views:
        target = mi.Bitmap(str(given.scene.with_suffix("") / f"{name}.exr")).convert(
            component_format=mi.Struct.Type.Float32
        )
        images = [np.array(target)] + [
            np.array(mi.render(scene, sensor=sensors[name], integrator=integrator, spp=given.spp))
            for scene in (fitted, mesh)
        ]
        rows.append(np.concatenate([over_white(image) for image in images], axis=1))
    given.figure.parent.mkdir(parents=True, exist_ok=True)
    write_png(given.figure, np.concatenate(rows, axis=0))


if __name__ == "__main__":
    main()
