"""What each encoding of generated garments loses: the table of docs/generation.md.

python pipelines/compare_encodings.py [--garments 100] [--side 64] [--seed 1] [--model FOLDER]
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import tyro

from gshell_mi.doctor import ensure_variant
from gshell_mi.errors import UserError
from gshell_mi.generation.converted import converted, round_trip
from gshell_mi.generation.encodings import ENCODINGS
from gshell_mi.generation.fields import TruncatedFields, normalised
from gshell_mi.generation.own_process import in_own_process
from gshell_mi.generation.request import coded
from gshell_mi.generation.sources import garment_sources
from gshell_mi.topology import topology


@dataclass(frozen=True)
class _Arguments:
    garments: int = 100
    """How many."""
    side: int = 64
    """Vertices per side of the grid."""
    seed: int = 1
    """Of the garments."""
    model: Path | None = None
    """Folder of a trained model, whose own code is compared, too."""


def main() -> None:
    given = tyro.cli(_Arguments)
    ensure_variant()
    kept, refused = [], []
    started = time.process_time()
    for source in garment_sources(given.garments, given.seed):
        try:
            kept.append(converted(source, given.side, most=1.0))
        except UserError as error:
            refused.append(f"{source.name}: {error}")
    seconds = (time.process_time() - started) / given.garments
    print(f"{len(kept)} of {given.garments} converted, {seconds:.2f} core seconds each; refused: {refused}")
    meshes = [normalised(row.source.mesh()[0], given.side)[0] for row in kept]

    print("| encoding | numbers | chamfer, mean (%) | worst (%) | loops right (%) | decoding (s) |")
    print("|---|---|---|---|---|---|")
    for name, encoding in ENCODINGS.items():
        codes = (encoding.encode(row.fields) for row in kept)
        _row(name, meshes, codes, lambda code, e=encoding: e.decode(code, given.side))
    if given.model is not None:
        fields = np.stack([np.stack([row.fields.sdf, row.fields.msdf]) for row in kept])
        again, numbers = in_own_process(coded, given.model, fields)
        _row("in the model", meshes, again, lambda pair: TruncatedFields(*pair), numbers)


def _row(
    name: str,
    meshes: list[trimesh.Trimesh],
    codes: Iterable,
    decode: Callable[..., TruncatedFields],
    numbers: int | None = None,
) -> None:
    """Prints a row of the table. Codes are made one by one: those of a thousand garments fill a memory.

    Args:
        numbers: of each code; default: they are counted.
    """
    counts, chamfer, right, seconds = [], [], [], 0.0
    for mesh, code in zip(meshes, codes, strict=True):
        counts.append(numbers if numbers is not None else sum(array.size for array in code.values()))
        begun = time.process_time()
        fields = decode(code)
        seconds += time.process_time() - begun
        again = fields.surface(largest=True)
        chamfer.append(round_trip(again, mesh))
        true, found = (topology(np.asarray(m.vertices), np.asarray(m.faces)) for m in (mesh, again))
        right.append((true.boundary_loops, true.components) == (found.boundary_loops, found.components))
    print(
        f"| {name} | {np.mean(counts):.0f} | {np.mean(chamfer):.4f} | {np.max(chamfer):.4f} | "
        f"{100 * np.mean(right):.1f} | {seconds / len(meshes):.3f} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
