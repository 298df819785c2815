"""The making of a data set, shard by shard."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np
import trimesh
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from ..bars import Bars
from ..doctor import ensure_variant
from ..errors import UserError
from ..files import replacing
from ..interrupt import check_interrupt
from ..lifetime import end_with_parent
from ..own_folder import OwnFolder, own_folder
from ..wording import counted
from .contact_sheet import picture, write_sheet
from .converted import converted
from .data_set import SHARD, DataSet, read_config, read_shard, write_config, write_shard
from .own_process import told_if_killed
from .sources import Source, garment_sources, mesh_sources

#: Objects on the page of pictures.
_SHOWN = 48


def make_data_set(
    output: Path,
    places: list[Path],
    *,
    garments: int = 0,
    seed: int = 0,
    side: int = 64,
    held_out: float = 0.1,
    most: float = 0.5,
    processes: int = 1,
    variant: str = "llvm_ad_rgb",
    quiet: bool = True,
) -> str:
    """Makes a data set, or goes on with one that is not finished; returns what to tell about it.

    Args:
        places: mesh files, folders of them, folders of fits.
        garments: generated ones to add.
        side: vertices per side of the grid, a multiple of 8.
        held_out: fraction of the objects that are kept for tests.
        most: chamfer distance, in per cent, beyond which an object is refused.

    Raises:
        UserError: there is nothing to convert, the folder is another's, or holds a set of other sources.
    """
    sources = mesh_sources(places) + garment_sources(garments, seed)
    described = json.dumps([source.to_dict() for source in sources] + [side, held_out, most])
    config = {
        "side": side,
        "classes": sorted({source.kind for source in sources}),
        "shards": -(-len(sources) // SHARD),
        "held_out": held_out,
        "max_chamfer": most,
        "objects": len(sources),
        "digest": hashlib.sha256(described.encode()).hexdigest(),
    }
    output.mkdir(parents=True, exist_ok=True)
    with own_folder(output, "dataset") as folder:
        old = read_config(output) if folder.is_marked() else None
        if old is not None and old.get("digest") != config["digest"]:
            raise UserError(
                f"'{output}' holds a data set of other sources or settings; choose another place with -o."
            )
        names = [DataSet.shard_name(number) for number in range(config["shards"])]
        folder.claim(*names, "sheet.png", "statistics.json")
        write_config(folder, config)
        (output / "shards").mkdir(exist_ok=True)
        waiting = [number for number, name in enumerate(names) if not (output / name).is_file()]
        jobs = [
            (output / names[number], sources[number * SHARD : (number + 1) * SHARD], side, held_out, most)
            for number in waiting
        ]
        started, done = time.perf_counter(), 0
        columns = (
            TextColumn("converting"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[rate]}"),
        )
        with Bars(*columns, quiet=quiet) as progress:
            bar = progress.add_task(
                "", total=len(sources), rate="", completed=len(sources) - sum(len(job[1]) for job in jobs)
            )

            def advance(objects: int) -> None:
                nonlocal done
                done += objects
                progress.update(bar, advance=objects, rate=f"{done / (time.perf_counter() - started):.2f}/s")

            _run(jobs, processes, variant, advance)
        statistics = _statistics(DataSet(output, config))
        statistics["seconds"] = round(time.perf_counter() - started, 2)
        _write_json(folder, "statistics.json", statistics)
        if statistics["objects"] == 0:
            reason = statistics["rejected"][0]
            raise UserError(
                f"None of {counted(len(sources), 'object')} could be used: {reason['name']}: "
                f"{reason['reason']}; all reasons are in '{output / 'statistics.json'}'."
            )
        _draw(DataSet(output, config), output / "sheet.png")
    rejected = len(statistics["rejected"])
    return (
        f"{output}: {counted(statistics['objects'], 'object')}, {statistics['held_out']} of them held "
        f"out; {rejected} refused (see statistics.json); chamfer {statistics['chamfer_mean']:.3f} %, "
        f"loops kept of {100 * statistics['loops_kept']:.1f} %"
    )


def _run(jobs: list[tuple], processes: int, variant: str, advance: Callable[[int], None]) -> None:
    if processes == 1 or len(jobs) < 2:
        for job in jobs:
            _convert_shard(*job, advance=advance)
        return
    # The processes are what runs side by side: threads of BLAS would wait for each other, for half the time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Spawned, as a process that has used Dr.Jit must not be forked.
    with (
        told_if_killed(),
        ProcessPoolExecutor(
            min(processes, len(jobs)),
            multiprocessing.get_context("spawn"),
            initializer=_begin,
            initargs=(variant,),
        ) as pool,
    ):
        futures = {pool.submit(_convert_shard, *job): len(job[1]) for job in jobs}
        try:
            for future in as_completed(futures):
                future.result()
                advance(futures[future])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _begin(variant: str) -> None:
    import drjit as dr

    end_with_parent()
    ensure_variant(variant)
    if variant.startswith("llvm"):
        dr.set_thread_count(1)  # the processes are what runs side by side


def _convert_shard(
    path: Path,
    sources: list[Source],
    side: int,
    held_out: float,
    most: float,
    *,
    advance: Callable[[int], None] = lambda _: None,
) -> None:
    rows, rejected = [], []
    for source in sources:
        check_interrupt()
        try:
            rows.append(converted(source, side, most=most))
        except UserError as error:
            rejected.append({"name": source.name, "reason": str(error)})
        advance(1)
    write_shard(path, rows, rejected, side, held_out)


def _statistics(found: DataSet) -> dict:
    records, rejected = [], []
    for number in range(found.config["shards"]):
        shard = read_shard(found.shard_path(number), found.side)
        records += shard.records
        rejected += shard.rejected
    chamfer = np.array([record.chamfer for record in records] or [0.0])
    return {
        "objects": len(records),
        "held_out": sum(record.held_out for record in records),
        "classes": dict(Counter(record.kind for record in records)),
        "loops": {str(loops): n for loops, n in sorted(Counter(r.loops for r in records).items())},
        "chamfer_mean": round(float(chamfer.mean()), 5),
        "chamfer_99": round(float(np.quantile(chamfer, 0.99)), 5),
        "loops_kept": round(sum(record.loops_kept for record in records) / max(len(records), 1), 5),
        "rejected": rejected,
    }


def _draw(found: DataSet, path: Path) -> None:
    pictures, labels = [], []
    for shard in found.shards():
        for index, record in enumerate(shard.records[: _SHOWN - len(pictures)]):
            mesh: trimesh.Trimesh = shard.fields(index).surface()
            pictures.append(picture(mesh))
            labels.append(f"{record.kind}, {counted(record.loops, 'loop')}")
        if len(pictures) >= _SHOWN:
            break
    write_sheet(path, pictures, labels)


def _write_json(folder: OwnFolder, name: str, found: dict) -> None:
    folder.claim(name)
    with replacing(folder.path / name) as partial:
        partial.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
