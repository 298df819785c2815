"""A capture as a fit scene: XML, sensors, targets; all of it or nothing."""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

import mitsuba as mi
import numpy as np

from ..compat import write_bitmap
from ..errors import UserError
from .camera import Camera

#: Marks a folder as written by this module, which may then replace it; says where everything came from.
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


def sensors_xml(cameras: dict[str, Camera], box: np.ndarray) -> str:
    """A scene document of the sensors, with clipping planes that hold the box (2, 3)."""
    reach = float(np.linalg.norm(np.ptp(box, axis=0)))
    parts = []
    for name, camera in cameras.items():
        distance = float(np.linalg.norm(camera.center - box.mean(axis=0)))
        parts.append(sensor_xml(name, camera, (max(1e-2 * distance, distance - 2 * reach),
                                               10 * (distance + reach))))
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
        emitter = (f'<emitter type="envmap" id="light"> <string name="filename" value={quoteattr(light)}/> '
                   f'</emitter>')
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
    (folder / RECORD).write_text(text, encoding="utf-8", errors="surrogateescape")


@dataclass(frozen=True)
class Record:
    """What an import noted of a scene; nothing, if no import wrote it.

    Attributes:
        photographs: by sensor id the file and the share of the object that it had clipped.
        to_scene: (4, 4) how the capture's world was turned.
    """

    photographs: dict[str, tuple[str, float]] = field(default_factory=dict)
    to_scene: np.ndarray = field(default_factory=lambda: np.eye(4))


def read_record(folder: Path) -> Record:
    """The record in the folder of a scene's targets."""
    try:
        stored = json.loads((folder / RECORD).read_text(encoding="utf-8", errors="surrogateescape"))
        photographs = {view["id"]: (view["image"], float(view["clipped"])) for view in stored["views"]}
        return Record(photographs, np.array(stored["capture_to_scene"], dtype=np.float64).reshape(4, 4))
    except (OSError, ValueError, KeyError, TypeError):
        return Record()


@contextmanager
def staged(output: Path, *, overwrite: bool, source: Path) -> Iterator[Path]:
    """A temporary folder that becomes ``output`` (an XML file) and the folder of its stem at the end.

    The block writes the XML file and that folder into it. If it fails, nothing remains and what was there
    before is untouched.

    Raises:
        UserError: something is there already and may not be replaced, or the place cannot be written.
    """
    folder = output.with_suffix("")
    if output.suffix != ".xml":
        raise UserError(f"The output '{output}' must end in .xml; the targets go into a folder of the same "
                        f"name beside it.")
    if folder.exists() and folder.resolve() in (source.resolve(), *source.resolve().parents):
        raise UserError(f"The output '{output}' would put its targets into '{folder}', where the capture is; "
                        f"choose another name.")
    if (output.exists() or folder.exists()) and not overwrite:
        there = output if output.exists() else folder
        raise UserError(f"'{there}' exists; replace it with --overwrite, or choose another output.")
    if folder.exists() and not (folder / RECORD).is_file():
        raise UserError(f"'{folder}' was not written by gshell_mi.capture, so --overwrite leaves it alone; "
                        f"remove it or choose another output.")
    partial = None
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        # On the same disk, so that moving it into place is a mere renaming.
        partial = Path(tempfile.mkdtemp(prefix=f".{output.stem}.", suffix=".partial", dir=output.parent))
        (partial / output.stem).mkdir()
        yield partial
        if folder.exists():
            os.replace(folder, partial / "replaced")
        os.replace(partial / output.stem, folder)
        os.replace(partial / output.name, output)
    except OSError as error:
        raise UserError(f"'{output}' cannot be written ({error.strerror or error}); free some space, mend "
                        f"its permissions or choose another output.") from error
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
