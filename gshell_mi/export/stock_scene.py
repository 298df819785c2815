"""Light and scene of a fit as files that stock Mitsuba loads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ..compat import environment_radiance, write_bitmap
from ..errors import UserError
from ..files import replacing
from ..material import ATTRIBUTES
from ..views import OPTICS, filter_of, kind_of

if TYPE_CHECKING:
    from ..light import EnvironmentLight

#: Longest path of the exported scene: direct light and three interreflections.
MAX_DEPTH = 5

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
{sensors}
</scene>
"""

_SENSOR = """\
    <sensor type="{kind}" id={id}>
        <float name="fov" value="{fov}"/>
        <string name="fov_axis" value="x"/>
{optics}
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
            <rfilter type="{rfilter}"/>
        </film>
    </sensor>"""


def write_light(path: Path, given: mi.Emitter, optimised: EnvironmentLight | None) -> None:
    """Writes the optimised light or, without one, that of the emitter ``given``, as a map in EXR."""
    if optimised:
        bitmap = mi.Bitmap(optimised.radiance)
    else:
        parameters = mi.traverse(given)
        if "data" in parameters:
            bitmap = mi.Bitmap(environment_radiance(given))
        else:
            radiance = np.array(parameters["radiance.value"], np.float32).ravel()
            bitmap = mi.Bitmap(np.broadcast_to(radiance, (8, 16, 3)).astype(np.float32))
    with replacing(path) as partial:
        write_bitmap(bitmap, partial)


def write_scene(path: Path, light: mi.Emitter, sensors: list[mi.Sensor]) -> None:
    """Writes a scene of ``mesh.ply`` and ``light.exr`` beside it, as the sensors see it.

    Args:
        light: the emitter whose rotation the map keeps.
        sensors: perspective or thin-lens sensors.
    """
    textures = "\n".join(
        f'                <texture type="mesh_attribute" name="{parameter}">\n'
        f'                    <string name="name" value="{attribute}"/>\n'
        f"                </texture>"
        for attribute, parameter in ATTRIBUTES.items()
    )
    light_to_world = ""
    parameters = mi.traverse(light)
    if "to_world" in parameters:
        light_to_world = (
            f'\n        <transform name="to_world">'
            f'<matrix value="{_matrix(parameters["to_world"].matrix)}"/></transform>'
        )
    text = _SCENE.format(
        depth=MAX_DEPTH,
        textures=textures,
        light_to_world=light_to_world,
        sensors="\n".join(_sensor(sensor) for sensor in sensors),
    )
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def up_axis(sensors: list[mi.Sensor]) -> int:
    """The world axis that points upwards in the sensors' images, on average: 0, 1 or 2 for x, y or z, and
    3, 4 or 5 for the opposite directions.

    >>> import mitsuba as mi
    >>> look = mi.ScalarTransform4f().look_at(origin=[0, -3, 1], target=[0, 0, 0], up=[0, 0, 1])
    >>> up_axis([mi.load_dict({"type": "perspective", "to_world": look})])
    2

    Raises:
        UserError: there is no sensor.
    """
    if not sensors:
        raise UserError(
            "The scene of the fit has no sensors, so nothing says which way is up; run the fit "
            "again, or put its scene.xml back."
        )
    up = np.mean(
        [np.array(mi.traverse(sensor)["to_world"].matrix).reshape(4, 4)[:3, 1] for sensor in sensors], axis=0
    )
    return int(np.argmax(np.concatenate([up, -up])))


def _sensor(sensor: mi.Sensor) -> str:
    parameters = mi.traverse(sensor)
    kind = kind_of(sensor)
    film = sensor.film()
    (width, height), (crop_width, crop_height) = film.size(), film.crop_size()
    crop_x, crop_y = film.crop_offset()
    optics = "\n".join(
        f'        <float name="{name}" value="{float(np.ravel(parameters[name])[0]):.9g}"/>'
        for name in OPTICS[kind]
    )
    return _SENSOR.format(
        kind=kind,
        id=quoteattr(sensor.id()),
        fov=float(parameters["x_fov"][0]),
        optics=optics,
        to_world=_matrix(parameters["to_world"].matrix),
        width=width,
        height=height,
        crop_width=crop_width,
        crop_height=crop_height,
        crop_x=crop_x,
        crop_y=crop_y,
        rfilter=filter_of(film),
    )


def _matrix(matrix: ArrayLike) -> str:
    return " ".join(f"{x:.9g}" for x in np.array(matrix, dtype=np.float64).reshape(4, 4).ravel())
