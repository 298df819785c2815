"""How good a model's samples are: a set of meshes against a data set."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

from ..bars import Bars
from ..errors import UserError
from ..evaluation.mesh_scores import read_mesh
from ..evaluation.self_intersections import piercing_edges
from ..json_files import read_json_object
from ..own_folder import OwnFolder
from .data_set import DataSet, Record
from .fields import TruncatedFields
from .set_scores import (
    chamfer_distances,
    coverage,
    earth_movers_distances,
    jensen_shannon_divergence,
    minimum_matching_distance,
    nearest_chamfer_distances,
    nearest_neighbour_accuracy,
)
from .surface_points import rim_points, surface_points

#: Points along the boundary of a shape.
_RIM_POINTS = 256


@dataclass(frozen=True)
class Samples:
    """Meshes that are scored."""

    points: np.ndarray
    """(n, p, 3)."""
    kinds: list[str]
    loops: list[int]
    components: list[int]
    rims: list[np.ndarray]
    """Points along the boundary of each, (p, 3) or (0, 3)."""
    piercing: list[int]
    """Edges of each that go through one of its own faces."""
    empty: int
    """Meshes without faces, left out of the rest."""
    seconds: float | None
    """Per sample; None where nobody knows."""


def read_samples(folder: Path, points: int) -> Samples:
    """The meshes that ``python -m gshell_mi.generate`` wrote into a folder. Needs a Mitsuba variant.

    Raises:
        UserError: it is no such folder, or its files are damaged.
    """
    if not OwnFolder(folder, "generate").is_marked() or not (folder / "samples.json").is_file():
        raise UserError(f"'{folder}' holds no samples; make some with python -m gshell_mi.generate.")
    try:
        told = read_json_object(folder / "samples.json")
        rows = [
            (
                str(row["file"]),
                str(row["class"]),
                int(row["loops"]),
                int(row["components"]),
                int(row["faces"]),
            )
            for row in told["samples"]
        ]
        seconds = float(told["seconds_per_sample"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"'{folder / 'samples.json'}' is damaged ({error}); sample again.") from error
    full = [row for row in rows if row[4] > 0]
    if not full:
        raise UserError(f"All samples in '{folder}' are empty; train the model for longer.")
    meshes = [read_mesh(folder / row[0]) for row in full]
    return Samples(
        np.array([surface_points(mesh, points, i)[0] for i, mesh in enumerate(meshes)]),
        [row[1] for row in full],
        [row[2] for row in full],
        [row[3] for row in full],
        [rim_points(mesh, _RIM_POINTS, i) for i, mesh in enumerate(meshes)],
        [len(piercing_edges(np.asarray(mesh.vertices), np.asarray(mesh.faces))) for mesh in meshes],
        len(rows) - len(full),
        seconds,
    )


def evaluate(
    samples: Samples, data: DataSet, *, points: int = 512, emd: int = 32, quiet: bool = True
) -> dict:
    """Scores of samples against the held-out objects of a data set. Needs a Mitsuba variant.

    Distances are of the cube [-1, 1]^3, in which both lie. Both sets are cut to the size of the smaller. The
    classes in turn are compared, so that both have the same share of each, as far as they can.

    Args:
        points: of each shape, for the chamfer distances.
        emd: shapes of each set for the earth mover's distance, of 128 points each; 0 for none.
    """
    true_records, sdf, msdf, true_points = data.load(held_out=True)
    train_records, train_points = data.load_points(held_out=False)
    mine, theirs = _paired(samples.kinds, [record.kind for record in true_records])
    a = samples.points[mine, :points].astype(np.float32)
    b = true_points[theirs, :points].astype(np.float32)
    trained = train_points[:, :points].astype(np.float32)
    columns = (
        TextColumn("comparing"),
        BarColumn(),
        TextColumn("{task.percentage:.0f} %"),
        TimeRemainingColumn(),
    )
    with Bars(*columns, quiet=quiet) as progress:
        few_a, few_b = (of[:emd, :128] for of in (a, b))
        bar = progress.add_task("", total=4 * len(a) + 3 * len(b) + 3 * len(few_a))

        def advance() -> None:
            progress.advance(bar)

        between = chamfer_distances(a, b, advance)
        among_a, among_b = (chamfer_distances(of, told=advance) for of in (a, b))
        to_trained, true_to_trained = (nearest_chamfer_distances(of, trained, told=advance) for of in (a, b))
        true_rims = []
        for i in theirs:
            true_rims.append(rim_points(TruncatedFields.stored(sdf[i], msdf[i]).surface(), _RIM_POINTS))
            advance()
        rims, true_rims = (
            np.array([rim for rim in found if len(rim)]).reshape(-1, _RIM_POINTS, 3)
            for found in ((samples.rims[i] for i in mine), true_rims)
        )
        between_rims = chamfer_distances(rims, true_rims, advance)
        moved, moved_a, moved_b = (
            earth_movers_distances(*pair, advance)
            for pair in ((few_a, few_b), (few_a, few_a), (few_b, few_b))
        )
    scores = {
        "samples": len(a),
        "true": len(b),
        "mmd": minimum_matching_distance(between),
        "coverage": coverage(between),
        "nearest_neighbour_accuracy": nearest_neighbour_accuracy(among_a, between, among_b),
        "jsd": jensen_shannon_divergence(a, b),
        "nearest_training": float(to_trained.mean()),
        "nearest_training_of_true": float(true_to_trained.mean()),
    }
    if between_rims.size:
        scores["mmd_boundary"] = minimum_matching_distance(between_rims)
    if emd:
        scores |= {
            "mmd_emd": minimum_matching_distance(moved),
            "coverage_emd": coverage(moved),
            "nearest_neighbour_accuracy_emd": nearest_neighbour_accuracy(moved_a, moved, moved_b),
        }
    return (
        scores
        | _topology(samples, train_records)
        | {"seconds_per_sample": samples.seconds, "empty": samples.empty}
    )


def _topology(samples: Samples, records: list[Record]) -> dict:
    """How many samples have loops that objects of their class have, one component, faces through others."""
    expected = defaultdict(set)
    for record in records:
        expected[record.kind].add(record.loops)
        expected["any"].add(record.loops)
    right = [loops in expected[kind] for kind, loops in zip(samples.kinds, samples.loops, strict=True)]
    return {
        "loops_as_class": float(np.mean(right)),
        "one_component": float(np.mean(np.array(samples.components) == 1)),
        # Triangles that cross have two such edges; a single one grazes a face, by rounding.
        "self_intersecting": float(np.mean(np.array(samples.piercing) > 1)),
    }


def _paired(kinds: list[str], others: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of as many of either, with the same classes in the same order; all that fit in where the
    classes differ."""
    mine, theirs = [], []
    for kind in sorted(set(kinds) & set(others)):
        here, there = ([i for i, k in enumerate(given) if k == kind] for given in (kinds, others))
        both = min(len(here), len(there))
        mine.append(here[:both])
        theirs.append(there[:both])
    if not mine:
        both = min(len(kinds), len(others))
        return np.arange(both), np.arange(both)
    # Turn by turn, so that a part of the set has all classes.
    order = np.argsort(np.concatenate([np.arange(len(part)) for part in mine]), kind="stable")
    return np.concatenate(mine)[order], np.concatenate(theirs)[order]
