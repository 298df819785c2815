"""Compares the kinds of lattices at equal vertex count, on a sphere whose signed distance is exact.

    python pipelines/compare_grids.py [--vertices 20000] [--repeats 5]

Prints a Markdown table: the resolution that gives the vertex count, the mean distance of the mesh from the
sphere (in thousandths of the radius), the mean angle between face normals and those of the sphere, how much
that angle depends on the direction of the surface (worst over best of 26 directions), the 5th percentile of
the triangles' smallest angle, and the time of an extraction with one thread. Averages are over spheres with
random centres.
"""

import argparse
import time

import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np

from gshell_mi.extraction import extract
from gshell_mi.lattice import GRIDS, make_lattice

_RADIUS = 0.7


def measure(grid: str, resolution: int, repeats: int) -> dict[str, float]:
    """Figures of one kind of lattice, averaged over ``repeats`` spheres."""
    lattice, rng = make_lattice(grid, resolution), np.random.default_rng(0)
    directions = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)]) - 1.0
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    vertices, distances, smallest, seconds = [], [], [], np.inf
    angles = [[] for _ in directions]
    for _ in range(repeats):
        centre = rng.uniform(-0.2, 0.2, 3)
        sdf = dr.norm(lattice.points(llvm.Float) - llvm.Array3f(*centre.tolist())) - _RADIUS
        dr.eval(sdf)
        dr.sync_thread()
        start = time.perf_counter()
        surface = extract(lattice, sdf)
        dr.sync_thread()
        seconds = min(seconds, time.perf_counter() - start)
        mesh = surface.to_trimesh()
        vertices.append(len(mesh.vertices))
        samples, _ = mesh.sample(100_000, return_index=True)
        distances.append(np.abs(np.linalg.norm(samples - centre, axis=1) - _RADIUS).mean())
        outward = mesh.triangles_center - centre
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        angle = np.degrees(np.arccos(np.clip((outward * mesh.face_normals).sum(axis=1), -1, 1)))
        nearest = (outward @ directions.T).argmax(axis=1)
        for i, found in enumerate(angles):
            found.append(np.average(angle[nearest == i], weights=mesh.area_faces[nearest == i]))
        smallest.append(np.percentile(np.degrees(mesh.face_angles.min(axis=1)), 5))
    by_direction = np.mean(angles, axis=1)
    return {
        "vertices": np.mean(vertices),
        "distance": 1e3 * np.mean(distances) / _RADIUS,
        "angle": by_direction.mean(),
        "ratio": by_direction.max() / by_direction.min(),
        "smallest": np.mean(smallest),
        "ms": 1e3 * seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vertices", type=int, default=20_000, help="vertices that each mesh should have")
    parser.add_argument("--repeats", type=int, default=5, help="spheres that are averaged over")
    arguments = parser.parse_args()
    dr.set_thread_count(1)
    print(
        "| grid | cells per side | vertices | distance (1e-3) | normals (degrees) | worst / best direction "
        "| smallest angle (degrees) | ms |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for grid in GRIDS:
        trial = measure(grid, 32, arguments.repeats)["vertices"]
        resolution = round(32 * (arguments.vertices / trial) ** 0.5)
        found = measure(grid, resolution, arguments.repeats)
        figures = (
            f"{found[name]:{digits}}"
            for name, digits in (
                ("vertices", ".0f"),
                ("distance", ".3f"),
                ("angle", ".2f"),
                ("ratio", ".2f"),
                ("smallest", ".1f"),
                ("ms", ".1f"),
            )
        )
        print(f"| `{grid}` | {resolution} | {' | '.join(figures)} |")


if __name__ == "__main__":
    main()
