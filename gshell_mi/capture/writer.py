"""A capture as a fit scene: XML, sensors, targets."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

import mitsuba as mi
import numpy as np

from ..compat import write_bitmap
from ..json_files import read_json
from .camera import Camera, rigid

#: Says where everything came from.
RECORD = "capture.json"


def sensor_xml(name: str, camera: Camera, depth: tuple[float, float]) -> str:
    """A ``perspective`` sensor without distortion and with square pixels.

    Args:
        name: its id.
        camera: ``fy`` and ``distortion`` are taken as equal to ``fx`` and as none.
        depth: near and far clipping distance, world units.
    """
    matrix = " ".join(f"{value:.9g}" for value in Camera.mitsuba_pose(camera.to_world).ravel())
    fov = math.degrees(2 * math.atan(camera.width / 2 / camera.fx))
    return f"""    <sensor type="perspective" id={quoteattr(name)}>
        <string name="fov_axis" value="x"/> <float name="fov" value="{fov:.9g}"/>
        <float name="principal_point_offset_x" value="{0.5 - camera.cx / camera.width:.9g}"/>
        <float name="principal_point_offset_y" value="{0.5 - camera.cy / camera.height:.9g}"/>
        <float name="near_clip" value="{depth[0]:.6g}"/> <float name="far_clip" value="{depth[1]:.6g}"/>
        <transform name="to_world"> <matrix value="{matrix}"/> </transform>
        <film type="hdrfilm">
            <integer name="width" value="{camera.width}"/> <integer name="height" value="{camera.height}"/>
            <string name="pixel_format" value="rgba"/> <rfilter type="{camera.rfilter}"/>
        </film>
        <sampler type="independent"> <integer name="sample_count" value="$spp"/> </sampler>
    </sensor>
"""


def clipping_depths(cameras: list[Camera], box: np.ndarray) -> tuple[float, float]:
    """Near and far clipping distances that hold the box (2, 3) for each of the cameras.

    They are the same for all, and powers of two: Mitsuba compiles them into its kernels as constants, so each
    pair of numbers that is new costs a compilation, in this import and in the next.

    >>> camera = Camera(4, 4, 4.0, 4.0, 2.0, 2.0, np.eye(4))
    >>> clipping_depths([camera], np.array([[-1.0, -1.0, 9.0], [1.0, 1.0, 11.0]]))
    (2.0, 256.0)
    """
    reach = float(np.linalg.norm(np.ptp(box, axis=0)))
    distances = [float(np.linalg.norm(camera.center - box.mean(axis=0))) for camera in cameras]
    near = min(max(1e-2 * distance, distance - 2 * reach) for distance in distances)
    far = 10 * (max(distances) + reach)
    return 2.0 ** math.floor(math.log2(max(near, 1e-6 * far))), 2.0 ** math.ceil(math.log2(far))


def sensors_xml(cameras: dict[str, Camera], depth: tuple[float, float]) -> str:
    """A scene document of the sensors, with near and far clipping distance ``depth``."""
    parts = [sensor_xml(name, camera, depth) for name, camera in cameras.items()]
    return '<scene version="3.0.0">\n    <default name="spp" value="256"/>\n' + "".join(parts) + "</scene>\n"


def scene_xml(stem: str, box: np.ndarray, resolution: int, light: str | None) -> str:
    """The fit scene's own document; the sensors are in ``<stem>/sensors.xml``.

    Args:
        box: (2, 3) corners of the cube that holds the object.
        light: file of an environment map beside the XML; None is an even light.
    """
    center, half = box.mean(axis=0), np.ptp(box, axis=0) / 2
    x, y, z = (f"{value:.9g}" for value in center)
    if light is None:
        emitter = '<emitter type="constant" id="light"> <rgb name="radiance" value="0.5"/> </emitter>'
    else:
        emitter = (
            f'<emitter type="envmap" id="light"> <string name="filename" value={quoteattr(light)}/> '
            f"</emitter>"
        )
    return f"""<scene version="3.0.0">
    <default name="spp" value="16"/>
    <!-- The unknown: to_world maps the cube [-1, 1]^3 to the box that holds the object. -->
    <shape type="gshell" id="subject">
        <integer name="resolution" value="{resolution}"/>
        <transform name="to_world">
            <scale value="{half.max():.9g}"/> <translate x="{x}" y="{y}" z="{z}"/>
        </transform>
    </shape>
    <!-- The light that the fit starts from. -->
    {emitter}
    <include filename={quoteattr(stem + "/sensors.xml")}/>
</scene>
"""


def write_target(path: Path, rgba: np.ndarray) -> None:
    """Writes (height, width, 4) linear premultiplied values as a half-float OpenEXR file.

    Raises:
        OSError: it cannot be written.
    """
    bitmap = mi.Bitmap(np.ascontiguousarray(rgba, dtype=np.float32), mi.Bitmap.PixelFormat.RGBA)
    write_bitmap(bitmap.convert(component_format=mi.Struct.Type.Float16), path)


def write_known(path: Path, known: np.ndarray) -> None:
    """Writes beside the target ``path`` what of it is known, (height, width) in [0, 1]; see ``targets``.

    Raises:
        OSError: it cannot be written.
    """
    bitmap = mi.Bitmap(np.ascontiguousarray(known[..., None], dtype=np.float32), mi.Bitmap.PixelFormat.Y)
    write_bitmap(bitmap.convert(component_format=mi.Struct.Type.Float16), path.with_suffix(".known.exr"))


def write_record(folder: Path, record: dict) -> None:
    text = json.dumps(record, indent=1, ensure_ascii=False) + "\n"
    # Names of photographs that are not UTF-8 become JSON's own escapes.
    (folder / RECORD).write_text(text, encoding="utf-8", errors="backslashreplace")


@dataclass(frozen=True)
class Record:
    """What an import noted of a scene; nothing, if no import wrote it.

    Attributes:
        photographs: by sensor id the file and the share of the object that it had clipped.
        to_scene: (4, 4) how the capture's world was turned.
    """

    photographs: dict[str, tuple[Path, float]] = field(default_factory=dict)
    to_scene: np.ndarray = field(default_factory=lambda: np.eye(4))


def read_record(folder: Path) -> Record:
    """The record in the folder of a scene's targets; an empty one if it is missing or damaged."""
    try:
        stored = read_json(folder / RECORD)
        photographs = {view["id"]: (Path(view["image"]), float(view["clipped"])) for view in stored["views"]}
        return Record(photographs, rigid(np.array(stored["capture_to_scene"], np.float64).reshape(4, 4)))
    except (OSError, ValueError, KeyError, TypeError, OverflowError):
        return Record()
