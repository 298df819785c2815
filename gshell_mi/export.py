"""The folder that a fit leaves behind; everything in it opens without this package."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from .compat import environment_radiance
from .errors import UserError
from .images import over_white, psnr, triptych, write_png
from .material import ATTRIBUTES
from .topology import topology

if TYPE_CHECKING:
    from .fit.config import FitConfig
    from .fit.joint import JointStage
    from .scene import FitScene

#: What an earlier fit may have left in a folder; nothing else is ever deleted.
_OWN_FILES = ("scene.xml", "mesh.ply", "template.ply", "light.exr", "metrics.json", "log.jsonl",
              "checkpoint.npz", "views")

_EXPORT_SPP = 32
_EXPORT_DEPTH = 5

_SCENE = """\
<scene version="3.0.0">
    <integrator type="path">
        <integer name="max_depth" value="{depth}"/>
        <boolean name="hide_emitters" value="true"/>
    </integrator>
    <shape type="ply" id="subject">
        <string name="filename" value="mesh.ply"/>
        <bsdf type="twosided">
            <bsdf type="principled">
{textures}
            </bsdf>
        </bsdf>
    </shape>
    <emitter type="envmap" id="light">
        <string name="filename" value="light.exr"/>{light_to_world}
    </emitter>
    <sensor type="perspective" id="{sensor_id}">
        <float name="fov" value="{fov}"/>
        <string name="fov_axis" value="x"/>
        <float name="principal_point_offset_x" value="{principal_x}"/>
        <float name="principal_point_offset_y" value="{principal_y}"/>
        <transform name="to_world">
            <matrix value="{to_world}"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="{width}"/>
            <integer name="height" value="{height}"/>
            <integer name="crop_width" value="{crop_width}"/>
            <integer name="crop_height" value="{crop_height}"/>
            <integer name="crop_offset_x" value="{crop_x}"/>
            <integer name="crop_offset_y" value="{crop_y}"/>
            <string name="pixel_format" value="rgba"/>
        </film>
    </sensor>
</scene>
"""


def check_output_folder(output: Path, *, keep: bool, overwrite: bool) -> None:
    """Checks, without a trace, that ``make_output_folder`` will succeed.

    Args:
        keep: the files of an earlier fit are welcome (resuming).
        overwrite: they may be deleted.

    Raises:
        UserError: the folder cannot be made or written, or holds an earlier fit.
    """
    existing = next(path for path in (output, *output.absolute().parents) if os.path.lexists(path))
    if not existing.is_dir():
        raise UserError(f"Output folder '{output}' cannot be made because '{existing}' is a file; "
                        f"choose another one with -o.")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise UserError(f"Output folder '{output}' cannot be written (no permission in '{existing}'); choose "
                        f"another one with -o.")
    earlier = _earlier(output)
    if earlier and not keep and not overwrite:
        raise UserError(f"'{output}' holds an earlier fit ({earlier[0].name}); continue it with --resume, "
                        f"replace it with --overwrite or choose another folder with -o.")


def make_output_folder(output: Path, *, keep: bool) -> None:
    """Makes the folder; deletes the files of an earlier fit in it unless ``keep``.

    Raises:
        UserError: the folder cannot be made or written.
    """
    try:
        output.mkdir(parents=True, exist_ok=True)
        probe = output / ".write_test"
        probe.write_bytes(b"")
        probe.unlink()
        for path in [] if keep else _earlier(output):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    except OSError as error:
        raise UserError(f"Output folder '{output}' cannot be written ({error.strerror}); "
                        f"choose another one with -o.") from error


def _earlier(output: Path) -> list[Path]:
    return [output / name for name in _OWN_FILES if (output / name).exists()]


def export_fit(output: Path, fit: FitScene, joint: JointStage, config: FitConfig,
               seconds: dict[str, float]) -> dict:
    """Writes meshes, light, scene, triptychs and ``metrics.json``; returns the metrics."""
    surface = fit.subject.surface
    vertices, faces, _ = surface.to_numpy()
    attributes = {}
    for name, field in joint.material.values().items():
        channels = 3 if name == "vertex_color" else 1
        values = np.array(surface.interpolate(field, channels).numpy())
        attributes[name] = values.T if channels == 3 else values
    _write_mesh(output / "mesh.ply", vertices, faces, attributes)
    template_vertices, template_faces, template_msdf = fit.subject.template().to_numpy()
    _write_mesh(output / "template.ply", template_vertices, template_faces, {"vertex_msdf": template_msdf})
    _write_light(output / "light.exr", fit, joint)
    _write_scene(output / "scene.xml", fit)
    scores = _write_views(output, fit)
    found = topology(vertices, faces)
    metrics = {
        "scene": fit.path.name,
        "psnr_training": round(float(np.mean(list(scores.values()))), 3),
        "psnr_per_view": {name: round(score, 3) for name, score in scores.items()},
        "counts": dataclasses.asdict(found),
        "seconds": {**seconds, "total": round(sum(seconds.values()), 3)},
        "versions": {name: version(name) for name in ("gshell_mi", "mitsuba", "drjit", "numpy")},
        "variant": mi.variant(),
        "config": dataclasses.asdict(config),
    }
    partial = output / ".metrics.json.partial"
    partial.write_text(json.dumps(metrics, indent=1))
    os.replace(partial, output / "metrics.json")
    return metrics


def _write_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray,
                attributes: dict[str, np.ndarray]) -> None:
    """A PLY with smooth normals in Mitsuba's naming: ``vertex_color`` is stored as ``color_0`` and so on."""
    columns = {"x": vertices[:, 0], "y": vertices[:, 1], "z": vertices[:, 2]}
    normals = _vertex_normals(vertices, faces)
    columns |= {"nx": normals[:, 0], "ny": normals[:, 1], "nz": normals[:, 2]}
    for name, values in attributes.items():
        for channel, column in enumerate(np.atleast_2d(values.T)):
            columns[f"{name.removeprefix('vertex_')}_{channel}"] = column
    header = "\n".join([
        "ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in columns),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""])
    table = np.empty((len(vertices), len(columns)), "<f4")
    for index, column in enumerate(columns.values()):
        table[:, index] = column
    rows = np.empty(len(faces), np.dtype([("count", "u1"), ("indices", "<i4", 3)]))
    rows["count"], rows["indices"] = 3, faces
    path.write_bytes(header.encode() + table.tobytes() + rows.tobytes())


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals, means of the faces' weighted by area."""
    normals = np.zeros((len(vertices), 3))
    if len(faces):
        a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
        weighted = np.cross(b - a, c - a)
        for corner in range(3):
            np.add.at(normals, faces[:, corner], weighted)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def _write_light(path: Path, fit: FitScene, joint: JointStage) -> None:
    if joint.light:
        bitmap = mi.Bitmap(joint.light.radiance)
    else:
        parameters = mi.traverse(fit.light)
        if "data" in parameters:
            bitmap = mi.Bitmap(environment_radiance(fit.light))
        else:
            radiance = np.array(parameters["radiance.value"], np.float32).ravel()
            bitmap = mi.Bitmap(np.broadcast_to(radiance, (8, 16, 3)).astype(np.float32))
    bitmap.write(str(path))


def _write_scene(path: Path, fit: FitScene) -> None:
    textures = "\n".join(
        f'                <texture type="mesh_attribute" name="{parameter}">\n'
        f'                    <string name="name" value="{attribute}"/>\n'
        f'                </texture>' for attribute, parameter in ATTRIBUTES.items())
    sensor = fit.sensors[0]
    parameters = mi.traverse(sensor)
    film = sensor.film()
    (width, height), (crop_width, crop_height) = film.size(), film.crop_size()
    crop_x, crop_y = film.crop_offset()
    # A thin lens has no principal point.
    principal_x, principal_y = (
        float(np.ravel(parameters[name])[0]) if name in parameters else 0.0
        for name in ("principal_point_offset_x", "principal_point_offset_y"))
    light_to_world = ""
    light = mi.traverse(fit.light)
    if "to_world" in light:
        light_to_world = (f'\n        <transform name="to_world">'
                          f'<matrix value="{_matrix(light["to_world"].matrix)}"/></transform>')
    path.write_text(_SCENE.format(
        depth=_EXPORT_DEPTH, textures=textures, light_to_world=light_to_world, sensor_id=sensor.id(),
        fov=float(parameters["x_fov"][0]), to_world=_matrix(parameters["to_world"].matrix),
        principal_x=principal_x, principal_y=principal_y, width=width, height=height, crop_width=crop_width,
        crop_height=crop_height, crop_x=crop_x, crop_y=crop_y))


def _matrix(matrix) -> str:
    return " ".join(f"{x:.9g}" for x in np.array(matrix, dtype=np.float64).reshape(4, 4).ravel())


def _write_views(output: Path, fit: FitScene) -> dict[str, float]:
    """Renders the exported scene from the training views; writes triptychs, returns PSNR by view id."""
    folder = output / "views"
    folder.mkdir(exist_ok=True)
    scene = mi.load_file(str(output / "scene.xml"))
    integrator = mi.load_dict({"type": "path", "max_depth": _EXPORT_DEPTH, "hide_emitters": True})
    scores = {}
    for sensor, target in zip(fit.sensors, fit.targets, strict=True):
        image = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=_EXPORT_SPP))
        scores[sensor.id()] = psnr(over_white(image), over_white(target.rgba))
        write_png(folder / f"{sensor.id()}.png", triptych(target.rgba, image))
    return scores
