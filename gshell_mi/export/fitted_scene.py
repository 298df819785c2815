"""The scene that a fit leaves behind, read back."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi

from ..environment_maps import environment_emitter
from ..errors import UserError
from ..scene_files import load_scene


def load_fitted_scene(folder: Path, envmap: Path | None = None) -> mi.Scene:
    """``scene.xml`` of a fit, lit by ``envmap`` if given.

    Raises:
        UserError: there is no fit in the folder, its scene has no sensors or no light, or the map is missing,
            no image or not finite.
    """
    path = Path(folder) / "scene.xml"
    if not path.is_file():
        raise UserError(f"'{folder}' holds no fit (scene.xml is missing); give the folder that a fit wrote.")
    scene = load_scene(path)
    for found, what in ((scene.sensors(), "sensors"), (scene.emitters(), "light"), (scene.shapes(), "shape")):
        if not found:
            raise UserError(f"'{path}' has no {what}, so a fit did not write it; run the fit again.")
    if envmap is None:
        return scene
    content = {"type": "scene", "light": environment_emitter(Path(envmap), "Environment map")}
    content |= {f"shape_{number}": shape for number, shape in enumerate(scene.shapes())}
    names = [sensor.id() for sensor in scene.sensors()]
    content |= {f"sensor_{number}": sensor for number, sensor in enumerate(scene.sensors())}
    relit = mi.load_dict(content)
    for sensor, name in zip(relit.sensors(), names, strict=True):
        sensor.set_id(name)  # any text, while a key of load_dict is not
    return relit
