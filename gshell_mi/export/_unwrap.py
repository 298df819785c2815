"""The process in which xatlas runs: ``python _unwrap.py MESH.npz ATLAS.npz SECONDS``.

It imports nothing else.
"""

import sys

import numpy as np


def main(given: str, found: str, seconds: str) -> None:
    import xatlas

    if sys.platform != "win32":
        import resource

        # Of the processors: a busy machine is no reason to go without textures.
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 1))

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
