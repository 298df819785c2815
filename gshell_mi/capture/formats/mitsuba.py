"""Images beside a Mitsuba XML file with a perspective sensor per image, such as renderings."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

from ...errors import UserError
from ...scene_files import is_scene_file, load_scene
from ...views import PinholeViews, filter_of
from ..camera import Camera
from ..decoding import image_size
from ..file_names import existing
from ..frames import Capture, Frame, pose_of

#: The format for people.
NAME = "Mitsuba sensors"

_Y_UP = np.array([0.0, 1.0, 0.0])


def find(source: Path) -> Path | None:
    """The XML file: the given one, or the only one in the folder that has sensors."""
    if source.is_file():
        return source if source.suffix.lower() == ".xml" and is_scene_file(source) else None
    found = [
        path
        for path in sorted(source.glob("*.xml"))
        if path.is_file() and is_scene_file(path) and b"<sensor" in path.read_bytes()
    ]
    named = [path for path in found if path.name == "sensors.xml"]
    if len(found) > 1 and not named:
        names = ", ".join(path.name for path in found)
        raise UserError(
            f"'{source}' has several XML files with sensors ({names}); give the one that you want."
        )
    return next(iter(named or found), None)


def read(source: Path, images: Path | None = None) -> Capture:
    """Reads the sensors; the image of a sensor is named by its id.

    Args:
        images: folder of the images; default: that of the XML file, or ``images`` in it.

    Raises:
        UserError: the file cannot be loaded, a sensor is no perspective camera, an image is missing or has
            another size than its film.
    """
    path = find(source)
    assert path is not None, "``find`` knows the source"
    try:
        path.read_text(encoding="utf-8")  # Mitsuba would take other bytes for names
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"'{path}' cannot be loaded by Mitsuba ({error}); correct the file.") from error
    sensors = load_scene(path).sensors()
    if not sensors:
        raise UserError(f"'{path}' has no sensors; add one per image, with the image's name as its id.")
    folders = [images] if images else [path.parent, path.parent / "images"]
    views = PinholeViews.from_sensors(sensors)
    frames = []
    for index, sensor in enumerate(sensors):
        image = next((file for folder in folders if (file := existing(folder / sensor.id()))), None)
        if image is None:
            raise UserError(
                f"Image '{folders[0] / sensor.id()}' of the sensor in '{path}' is missing, with "
                f"any suffix such as .exr; put it there or name its folder with --images."
            )
        camera = camera_of(sensor, views, index)
        width, height = image_size(image)
        if (width, height) != (camera.width, camera.height):
            raise UserError(
                f"Image '{image}' is {width} x {height} pixels, but its sensor's film is "
                f"{camera.width} x {camera.height}; resize one of them."
            )
        frames.append(Frame(image, camera))
    return Capture(NAME, source, tuple(frames), up=_Y_UP)


def camera_of(sensor: mi.Sensor, views: PinholeViews, index: int) -> Camera:
    """The camera of a sensor, with intrinsics from the rays at its film's corners.

    Args:
        views: measured from a list that has the sensor at ``index``.

    Raises:
        UserError: its ``to_world`` is no rigid motion.
    """
    width, height = views.sizes[index]
    matrix = np.array(mi.traverse(sensor)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    pose = Camera.mitsuba_pose(pose_of(matrix, f"sensor '{sensor.id()}'"))
    film = pose[:3, :3].T @ views.bases[index]
    fx, fy = width / film[0, 0], height / film[1, 1]
    rfilter = filter_of(sensor.film())
    return Camera(int(width), int(height), fx, fy, -film[0, 2] * fx, -film[1, 2] * fy, pose, rfilter=rfilter)
