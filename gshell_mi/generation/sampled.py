"""From a trained model to a folder of meshes."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import trimesh

from ..bars import Bars
from ..errors import UserError
from ..evaluation.mesh_scores import read_mesh
from ..files import replacing
from ..own_folder import OwnFolder, own_folder
from ..topology import topology
from ..triangles import unit
from ..wording import counted
from .contact_sheet import picture, write_sheet
from .fields import TruncatedFields, normalised
from .model_config import ModelConfig
from .request import Request, sampled_fields
from .unseen import seen_points

_FPS = 12
#: Cells around the seen part of a fit that are held fixed with it.
_HELD_CELLS = 2.0


def generate(
    model: Path,
    output: Path,
    *,
    count: int = 16,
    kind: str | None = None,
    seed: int = 0,
    guidance: float = 1.0,
    steps: int = 32,
    interpolate: tuple[int, int] | None = None,
    near: Path | None = None,
    strength: float = 0.5,
    complete: Path | None = None,
    suffix: str = "ply",
    batch: int = 16,
    device: str = "auto",
    quiet: bool = True,
) -> str:
    """Samples meshes into a folder; returns what to tell about them. Needs a Mitsuba variant.

    The meshes lie in [-1, 1]^3; with ``near`` or ``complete`` they have the place and size of what was given.

    Args:
        model: the folder of a trained model.
        kind: a class; None for all in turn.
        interpolate: two seeds between which the samples lead.
        near: a fit's folder or a mesh file.
        complete: a fit's folder.

    Raises:
        UserError: the model or what it shall start from is missing or damaged, the class unknown, or a file
            that is none of ours in the way.
    """
    config = ModelConfig.read(model / "model.json")
    classes = config.classes
    if kind is not None and kind not in classes:
        raise UserError(f"class '{kind}' is none that the model knows; choose one of {', '.join(classes)}")
    start, known, back = None, None, np.eye(4)
    if near is not None or complete is not None:
        start, known, back = _given(near, complete, config.side)
    numbers = [
        classes.index(kind) if kind else (None if start is not None else i % len(classes))
        for i in range(count)
    ]
    if interpolate is None:
        seeds = [(seed + i, seed + i, 0.0) for i in range(count)]
    else:
        numbers = [classes.index(kind) if kind else None] * count
        seeds = [(*interpolate, float(part)) for part in np.linspace(0, 1, count)]
    request = Request(
        numbers,
        seeds,
        guidance,
        steps,
        batch,
        device,
        start,
        1.0 if complete is not None else strength,
        known,
        quiet,
    )
    names = [f"meshes/{index:04d}.{suffix}" for index in range(count)]
    film = ["interpolation.mp4"] if interpolate is not None else []
    written = ["fields.npz", "samples.json", "sheet.png", *film, *names]
    output.mkdir(parents=True, exist_ok=True)
    with own_folder(output, "generate") as folder:
        folder.check_free(written)  # before the work
        fields, seconds = sampled_fields(model, request)
        folder.clear()
        folder.claim(*written)
        return _write(
            folder,
            names,
            fields,
            [classes[n] if n is not None else "any" for n in numbers],
            seeds,
            back,
            seconds,
            film=bool(film),
            quiet=quiet,
        )


def _given(
    near: Path | None, complete: Path | None, side: int
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Fields to start from, where they are known, and the matrix back to the world."""
    place = near if complete is None else complete
    if place is None:
        raise ValueError("there is nothing to start from")
    mesh, back = normalised(read_mesh(place / "mesh.ply" if place.is_dir() else place), side)
    fields = TruncatedFields.of_mesh(mesh, side)
    start = np.stack([fields.sdf, fields.msdf])
    if complete is None:
        return start, None, back
    seen = seen_points(complete, mesh, back)
    return start, near_points(seen, side, _HELD_CELLS), back


def near_points(points: np.ndarray, side: int, cells: float) -> np.ndarray:
    """(N, N, N) bool: the grid's vertices, by ``[z, y, x]``, within some cells of the surface that was seen.

    Args:
        points: (n, 4): places on the surface, and 1 for those that were seen.
    """
    from scipy.spatial import cKDTree

    axis = np.linspace(-1, 1, side)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    distance, nearest = cKDTree(points[:, :3]).query(np.stack([x, y, z], axis=-1).reshape(-1, 3))
    seen = points[nearest, 3] > 0.5
    return (seen & (distance < cells * 2 / (side - 1))).reshape(side, side, side)


def _write(
    folder: OwnFolder,
    names: list[str],
    fields: np.ndarray,
    kinds: list[str],
    seeds: list,
    back: np.ndarray,
    seconds: float,
    *,
    film: bool,
    quiet: bool,
) -> str:
    (folder.path / "meshes").mkdir(exist_ok=True)
    pictures, labels, told = [], [], []
    with Bars(quiet=quiet) as progress:
        bar = progress.add_task("meshes", total=len(fields))
        for index, (pair, kind, name) in enumerate(zip(fields, kinds, names, strict=True)):
            began = time.perf_counter()
            mesh = TruncatedFields(*pair).surface(largest=True)
            seconds += time.perf_counter() - began
            found = topology(np.asarray(mesh.vertices), np.asarray(mesh.faces))
            told.append(
                {
                    "file": name,
                    "class": kind,
                    "seeds": seeds[index],
                    "loops": found.boundary_loops,
                    "components": found.components,
                    "faces": found.faces,
                }
            )
            labels.append(f"{kind}, {counted(found.boundary_loops, 'loop')}")
            if len(mesh.faces):
                pictures.append(picture(mesh))
                _write_mesh(folder.path / name, mesh, back)
            else:
                pictures.append(np.full((128, 128, 3), 255, np.uint8))
            progress.advance(bar)
    with replacing(folder.path / "fields.npz") as partial:
        np.savez_compressed(partial, fields=fields.astype(np.float16))
    with replacing(folder.path / "samples.json") as partial:
        partial.write_text(
            json.dumps({"seconds_per_sample": seconds / len(fields), "samples": told}, indent=1) + "\n",
            encoding="utf-8",
        )
    write_sheet(folder.path / "sheet.png", pictures, labels)
    if film:
        from ..turntable.video import write_video

        there_and_back = [*pictures, *pictures[-2:0:-1]]
        write_video(
            (frame / 255.0 for frame in there_and_back), folder.path / "interpolation.mp4", _FPS, gif=False
        )
    return (
        f"{folder.path}: {counted(len(fields), 'sample')} in {seconds:.1f} s "
        f"({seconds / len(fields):.2f} s each); see sheet.png"
    )


def _write_mesh(path: Path, mesh: trimesh.Trimesh, back: np.ndarray) -> None:
    """Writes a mesh in its place in the world, as PLY or GLB."""
    from ..export.gltf import Part, write_glb
    from ..export.ply import write_ply

    placed = trimesh.Trimesh(mesh.vertices @ back[:3, :3].T + back[:3, 3], mesh.faces, process=False)
    normals = unit(np.asarray(placed.vertex_normals))
    if path.suffix == ".ply":
        write_ply(path, placed.vertices, placed.faces, normals, {})
        return
    given = {"POSITION": np.asarray(placed.vertices, np.float32), "NORMAL": normals.astype(np.float32)}
    write_glb(path, [Part("sample", placed.faces, given, {"doubleSided": True})])
