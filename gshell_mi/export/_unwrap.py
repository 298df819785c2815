"""The process in which xatlas runs: ``python _unwrap.py MESH.npz ATLAS.npz``. Imports nothing else."""

import sys

import numpy as np


def main(given: str, found: str) -> None:
    import xatlas

    with np.load(given) as arrays:
        atlas = xatlas.Atlas()
        atlas.add_mesh(arrays["vertices"], arrays["faces"])
        options = xatlas.PackOptions()
        options.resolution = int(arrays["texture_size"])
        options.padding = int(arrays["padding"])
        options.bilinear = True
    atlas.generate(xatlas.ChartOptions(), options)
    source, faces, uv = atlas[0]
    np.savez(found, source=source, faces=faces, uv=uv, charts=atlas.chart_count)


if __name__ == "__main__":
    main(*sys.argv[1:])
