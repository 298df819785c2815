"""What a scene contains, and which parts of it the integrators cannot differentiate correctly."""

from __future__ import annotations

import warnings

import mitsuba as mi

from ..errors import UserError


def has_surface_emitters(scene: mi.Scene) -> bool:
    """Whether the scene has any area light."""
    return any(mi.has_flag(e.flags(), mi.EmitterFlags.Surface) for e in scene.emitters())


def has_bsdf_flag(scene: mi.Scene, flag: mi.BSDFFlags) -> bool:
    """Whether any surface has a BSDF with the given ``BSDFFlags``."""
    return any(
        shape.bsdf() is not None and mi.has_flag(shape.bsdf().flags(), flag) for shape in scene.shapes()
    )


def sensor_of(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """A sensor, which may be given by its number in the scene."""
    return scene.sensors()[sensor] if isinstance(sensor, int) else sensor


def check_sensor(sensor: mi.Sensor) -> None:
    """Raises for sensors whose silhouettes are not those of one viewpoint, and for special films."""
    if sensor.class_name() != "PerspectiveCamera":
        raise UserError(
            f"Sensor '{sensor.id()}' is a {sensor.class_name()}: gshell_path and gshell_mask "
            "differentiate 'perspective' sensors only; use one of these, or mi.render() "
            "without derivatives."
        )
    if mi.has_flag(sensor.film().flags(), mi.FilmFlags.Special):
        raise UserError(
            f"The film of sensor '{sensor.id()}' has its own sample format, which gshell_path "
            "and gshell_mask cannot differentiate; use 'hdrfilm'."
        )


def check_meshes(scene: mi.Scene) -> None:
    """Raises for meshes without faces, from whose empty buffers Mitsuba cannot read."""
    for shape in scene.shapes():
        if shape.is_mesh() and shape.face_count() == 0:
            raise UserError(
                f"Mesh '{shape.id()}' has no face, which Mitsuba cannot render; leave it out, or "
                "give it a face whose three corners are the same."
            )


def unsupported(scene: mi.Scene) -> list[str]:
    """Sentences about what the derivatives of this scene leave out.

    >>> scene = mi.load_dict({'type': 'scene', 'ball': {'type': 'sphere', 'id': 'ball'}})
    >>> unsupported(scene)
    ["Shape 'ball' (Sphere) is no triangle mesh: its silhouettes have no derivative."]
    """
    sentences = []
    for shape in scene.shapes():
        if not shape.is_mesh():
            sentences.append(
                f"Shape '{shape.id()}' ({shape.class_name()}) is no triangle mesh: its "
                "silhouettes have no derivative."
            )
        bsdf = shape.bsdf()
        if bsdf is not None and any(
            mi.has_flag(bsdf.flags(), flag)
            for flag in (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)
        ):
            sentences.append(
                f"Shape '{shape.id()}' is a perfect mirror or glass: silhouettes seen in or "
                "through it have no derivative."
            )
        elif bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null):
            sentences.append(
                f"Shape '{shape.id()}' is partly transparent: shadows seen through it have no derivative."
            )
    return sentences


def warn_once(scene: mi.Scene, said: set[str]) -> None:
    """Warns of everything in ``unsupported`` that is not in the set ``said``, and adds it there."""
    for sentence in unsupported(scene):
        if sentence not in said:
            said.add(sentence)
            warnings.warn(sentence, RuntimeWarning, stacklevel=2)
