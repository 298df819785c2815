"""The folder that a fit leaves behind; everything in it opens without this package."""

from __future__ import annotations

import dataclasses
import json
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from ..files import replacing
from ..images import over_white, psnr, triptych, write_png
from ..light import turns_with_camera
from ..own_folder import OwnFolder
from ..scene_files import load_scene
from ..subdivision import subdivided
from ..topology import topology
from ..triangles import unit
from .ply import write_ply
from .slivers import without_slivers
from .stock_scene import MAX_DEPTH, write_light, write_scene

if TYPE_CHECKING:
    from ..extraction import SurfaceMesh
    from ..light import EnvironmentLight
    from ..material import GivenMaterial, MaterialField
    from ..scene import FitScene

_EXPORT_SPP = 32


def export_fit(output: Path, fit: FitScene, material: MaterialField | GivenMaterial,
               light: EnvironmentLight | None, views: int, texture: np.ndarray | None = None,
               texture_levels: int = 0, *, light_turns: bool = False) -> dict:
    """Writes meshes, light, scene and triptychs.

    Args:
        fit: its subject is the result.
        light: None if it is the scene's own.
        views: how many, spread evenly, are rendered.
        texture: base colours at the vertices of the surface's mesh, divided ``texture_levels`` times; None
            leaves those of the material.
        light_turns: whether the light turns with the camera: then it is stored as the first view has it.

    Returns:
        The metrics, which ``write_metrics`` stores.
    """
    shown = np.unique(np.linspace(0, len(fit.sensors) - 1, views).round().astype(int))
    OwnFolder(output, "fit").claim("mesh.ply", "template.ply", "light.exr", "scene.xml",
                                   *(f"views/{fit.sensors[index].id()}.png" for index in shown))
    surface = fit.subject.surface
    attributes = {}
    for name, field in material.values().items():
        channels = 3 if name == "vertex_color" else 1
        values = np.array(surface.interpolate(field, channels).numpy())
        attributes[name] = values.T if channels == 3 else values
    _write_surface(output / "mesh.ply", surface, attributes, texture, texture_levels)
    template = fit.subject.template()
    _write_surface(output / "template.ply", template, {"vertex_msdf": template.to_numpy()[2]})
    write_light(output / "light.exr", fit.light, light)
    write_scene(output / "scene.xml", fit.light, fit.sensors)
    turns = turns_with_camera(fit.sensors) if light and light_turns else []
    scores = _write_views(output, fit, shown, [light.turned(turn) for turn in turns] if light else [])
    vertices, faces, _ = surface.to_numpy()
    return {
        "scene": fit.path.name,
        "targets": str(fit.targets[0].path.parent.absolute()),
        "psnr_training": round(float(np.mean(list(scores.values()))), 3),
        "psnr_per_view": {name: round(score, 3) for name, score in scores.items()},
        "counts": dataclasses.asdict(topology(vertices, faces)),
        "versions": {name: version(name) for name in ("gshell_mi", "mitsuba", "drjit", "numpy")},
        "variant": mi.variant(),
    }


def write_metrics(output: Path, metrics: dict, seconds: dict[str, float]) -> dict:
    """Writes ``metrics.json`` in one step, with the seconds per stage and their sum; returns its contents."""
    metrics = metrics | {"seconds": {**seconds, "total": round(sum(seconds.values()), 3)}}
    OwnFolder(output, "fit").claim("metrics.json")
    with replacing(output / "metrics.json") as partial:
        partial.write_text(json.dumps(metrics, indent=1), encoding="utf-8")
    return metrics


def _write_surface(path: Path, surface: SurfaceMesh, attributes: dict[str, np.ndarray],
                   texture: np.ndarray | None = None, levels: int = 0) -> None:
    vertices, faces, _ = surface.to_numpy()
    normals = np.array(surface.vertex_normals().numpy()).T.reshape(-1, 3)
    vertices = without_slivers(vertices, faces, normals)
    if texture is not None:
        vertices, faces, attributes = subdivided(vertices, faces, {"normal": normals} | attributes, levels)
        normals, attributes["vertex_color"] = unit(attributes.pop("normal")), texture
    write_ply(path, vertices, faces, normals, attributes)


def _write_views(output: Path, fit: FitScene, shown: np.ndarray,
                 lights: list[mi.Transform4f]) -> dict[str, float]:
    """Renders the exported scene from the views ``shown``; writes triptychs, returns PSNR by view id.

    Args:
        lights: per view ``to_world`` of the light, if it turns with the camera.
    """
    folder = output / "views"
    folder.mkdir(exist_ok=True)
    scene = load_scene(output / "scene.xml")
    integrator = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH, "hide_emitters": True})
    scores, parameters = {}, mi.traverse(scene)
    for index in shown:
        sensor, target = fit.sensors[index], fit.targets[index]
        if lights:
            parameters["light.to_world"] = lights[index]
            parameters.update()
        image = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=_EXPORT_SPP))
        scores[sensor.id()] = psnr(over_white(image), over_white(target.rgba))
        write_png(folder / f"{sensor.id()}.png", triptych(target.rgba, image))
    return scores
