"""The scene that a fit leaves behind, read back."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi

from ..errors import UserError


def load_fitted_scene(folder: Path, envmap: Path | None = None) -> mi.Scene:
    """``scene.xml`` of a fit, lit by ``envmap`` if given.

    Raises:
        UserError: there is no fit in the folder, or the map is missing or no image.
    """
    if not (folder / "scene.xml").is_file():
        raise UserError(f"'{folder}' holds no fit (scene.xml is missing); give the folder that a fit wrote.")
    scene = load_scene(folder / "scene.xml")
    if envmap is None:
        return scene
    if not Path(envmap).is_file():
        raise UserError(f"Environment map '{envmap}' does not exist; check the path.")
    try:
        light = mi.load_dict({"type": "envmap", "id": "light", "filename": str(envmap)})
    except Exception as error:
        raise UserError(f"Environment map '{envmap}' cannot be read; give a latitude-longitude image in "
                        f"OpenEXR.") from error
    content = {"type": "scene", "light": light}
    content |= {f"shape_{number}": shape for number, shape in enumerate(scene.shapes())}
    return mi.load_dict(content | {sensor.id(): sensor for sensor in scene.sensors()})


def load_scene(path: Path) -> mi.Scene:
    """A Mitsuba scene file; ``UserError`` if it is missing or Mitsuba refuses it."""
    if not Path(path).is_file():
        raise UserError(f"Scene '{path}' does not exist; check the path.")
    try:
        return mi.load_file(str(path))
    except Exception as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise UserError(f"Scene '{path}' cannot be loaded by Mitsuba: {reason}") from error
