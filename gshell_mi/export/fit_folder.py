"""The folder that a fit leaves behind; everything in it opens without this package."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import __version__
from ..files import replacing
from ..light import turned_for
from ..material import attributes_of
from ..own_folder import OwnFolder
from ..subdivision import subdivided
from ..topology import topology
from ..triangles import unit
from .ply import write_ply
from .slivers import without_slivers
from .stock_scene import write_light, write_scene
from .views import HELD_OUT, TRAINING, view_files, write_views

if TYPE_CHECKING:
    from ..extraction import SurfaceMesh
    from ..light import EnvironmentLight
    from ..material import GivenMaterial, MaterialField
    from ..scene import FitScene, View


def export_fit(
    output: Path,
    given: FitScene,
    material: MaterialField | GivenMaterial,
    light: EnvironmentLight | None,
    views: int,
    texture: np.ndarray | None = None,
    texture_levels: int = 0,
    *,
    light_turns: bool = False,
    gains: np.ndarray | None = None,
    laid: Sequence[View] = (),
) -> dict:
    """Writes meshes, light, scene and pictures of the views.

    Args:
        given: its subject is the result.
        light: None if it is the scene's own.
        views: how many training views, spread evenly, are rendered; of those held out, all are.
        texture: base colours at the vertices of the surface's mesh, divided ``texture_levels`` times; None
            leaves those of the material.
        light_turns: whether the light turns with the camera: then it is stored as the first view has it.
        gains: (N, 3) that each view's channels are multiplied by, as its target was exposed so; None if all
            were exposed alike.
        laid: the held-out views with corrected cameras, which are scored besides; none if as given.

    Returns:
        The metrics, which ``write_metrics`` stores.
    """
    count = len(given.sensors)
    chosen = np.unique(np.linspace(0, count - 1, min(views, count)).round().astype(int))
    shown = {TRAINING: [given.training[index] for index in chosen], HELD_OUT: given.held_out}
    names = [[view.sensor.id() for view in group] for group in shown.values()]
    OwnFolder(output, "fit").claim("mesh.ply", "template.ply", "light.exr", "scene.xml", *view_files(*names))
    surface = given.subject.surface
    vertices, faces = _write_surface(
        output / "mesh.ply", surface, attributes_of(material, surface), texture, texture_levels
    )
    template = given.subject.template()
    _write_surface(output / "template.ply", template, {"vertex_msdf": template.to_numpy()[2]})
    write_light(output / "light.exr", given.light, light)
    write_scene(output / "scene.xml", given.light, given.sensors)

    def scored(folder: str | None, group: Sequence[View]) -> dict:
        # The first training view has the light as it is stored.
        sensors = [view.sensor for view in group]
        lights = turned_for(light.to_world, given.sensors[0], sensors) if light and light_turns else []
        exposed = gains[chosen] if folder == TRAINING and gains is not None else ()
        return write_views(output, folder, group, lights, exposed)

    scores = {folder: scored(folder, group) for folder, group in shown.items() if group}
    return {
        "scene": given.path.name,
        "targets": str(given.targets[0].path.parent.absolute()),
        "psnr_training": scores[TRAINING]["mean"]["psnr"],
        "training": scores[TRAINING],
        **({"held_out": scores[HELD_OUT]} if given.held_out else {}),
        **({"held_out_laid": scored(None, laid)} if laid else {}),
        **({} if gains is None else {"exposures": _exposures(given, gains)}),
        "counts": dataclasses.asdict(topology(vertices, faces)),
        "versions": {
            "gshell_mi": __version__,
            "mitsuba": mi.__version__,
            "drjit": dr.__version__,
            "numpy": np.__version__,
        },
        "variant": mi.variant(),
    }


def write_metrics(output: Path, metrics: dict, seconds: dict[str, float]) -> dict:
    """Writes ``metrics.json`` in one step, with the seconds per stage and their sum; returns its contents."""
    metrics = metrics | {"seconds": {**seconds, "total": round(sum(seconds.values()), 3)}}
    OwnFolder(output, "fit").claim("metrics.json")
    with replacing(output / "metrics.json") as partial:
        partial.write_text(json.dumps(metrics, indent=1), encoding="utf-8")
    return metrics


def _exposures(given: FitScene, gains: np.ndarray) -> dict[str, Any]:
    """How (N, 3) gains expose the views: the mean of their channels in stops, what these differ by from it,
    and their spread."""
    names, channels = [sensor.id() for sensor in given.sensors], np.log2(gains)
    stops = channels.mean(axis=1)
    return {
        "spread_stops": round(float(stops.std()), 4),
        "spread_white_balance": round(float((channels - stops[:, None]).std()), 4),
        "stops": {name: round(float(value), 4) for name, value in zip(names, stops, strict=True)},
        "gains": {
            name: [round(float(value), 5) for value in gain] for name, gain in zip(names, gains, strict=True)
        },
    }


def _write_surface(
    path: Path,
    surface: SurfaceMesh,
    attributes: dict[str, np.ndarray],
    texture: np.ndarray | None = None,
    levels: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices and faces that are written."""
    vertices, faces, _ = surface.to_numpy()
    normals = np.array(surface.vertex_normals().numpy()).T.reshape(-1, 3)
    vertices = without_slivers(vertices, faces, normals)
    if texture is not None:
        vertices, faces, attributes = subdivided(vertices, faces, {"normal": normals} | attributes, levels)
        normals, attributes["vertex_color"] = unit(attributes.pop("normal")), texture
    write_ply(path, vertices, faces, normals, attributes)
    return vertices, faces
