"""What a scene contains, and which parts of it the integrators cannot differentiate correctly."""

import warnings

import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..wording import counted


def has_surface_emitters(scene):
    """Whether the scene has any area light."""
    return any(mi.has_flag(e.flags(), mi.EmitterFlags.Surface) for e in scene.emitters())


def has_bsdf_flag(scene, flag):
    """Whether any surface has a BSDF with the given ``BSDFFlags``."""
    return any(shape.bsdf() is not None and mi.has_flag(shape.bsdf().flags(), flag)
               for shape in scene.shapes())


def check_sensor(sensor):
    """Raises for sensors whose silhouettes are not those of one viewpoint, and for special films."""
    if sensor.class_name() != "PerspectiveCamera":
        raise UserError(f"Sensor '{sensor.id()}' is a {sensor.class_name()}: gshell_path and gshell_mask "
                        "differentiate 'perspective' sensors only; use one of these, or mi.render() "
                        "without derivatives.")
    if mi.has_flag(sensor.film().flags(), mi.FilmFlags.Special):
        raise UserError(f"The film of sensor '{sensor.id()}' has its own sample format, which gshell_path "
                        "and gshell_mask cannot differentiate; use 'hdrfilm'.")


def check_meshes(scene):
    """Raises for meshes without faces, from whose empty buffers Mitsuba cannot read."""
    for shape in scene.shapes():
        if shape.is_mesh() and shape.face_count() == 0:
            raise UserError(f"Mesh '{shape.id()}' has no face, which Mitsuba cannot render; leave it out, or "
                            "give it a face whose three corners are the same.")


def unsupported(scene):
    """Sentences about what the derivatives of this scene leave out.

    >>> scene = mi.load_dict({'type': 'scene', 'ball': {'type': 'sphere', 'id': 'ball'}})
    >>> unsupported(scene)
    ["Shape 'ball' (Sphere) is no triangle mesh: its silhouettes have no derivative."]
    """
    sentences = []
    for shape in scene.shapes():
        if not shape.is_mesh():
            sentences.append(f"Shape '{shape.id()}' ({shape.class_name()}) is no triangle mesh: its "
                             "silhouettes have no derivative.")
        bsdf = shape.bsdf()
        if bsdf is not None and any(mi.has_flag(bsdf.flags(), flag) for flag in
                                    (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)):
            sentences.append(f"Shape '{shape.id()}' is a perfect mirror or glass: silhouettes seen in or "
                             "through it have no derivative.")
        elif bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null):
            sentences.append(f"Shape '{shape.id()}' is partly transparent: shadows seen through it have no "
                             "derivative.")
    return sentences


def repeated_faces(meshes):
    """Sentences about meshes some of whose faces are there twice, on whatever side."""
    sentences = []
    for mesh in meshes:
        faces = np.sort(np.array(mi.traverse(mesh)["faces"]).reshape(-1, 3), axis=1)
        faces = faces[faces[:, 0] < faces[:, 2]]    # a gshell's padding is no face
        repeated = len(faces) - len(np.unique(faces, axis=0))
        if repeated:
            sentences.append(f"Mesh '{mesh.id()}' has {counted(repeated, 'repeated face')}: derivatives of "
                             "shadows count their silhouettes twice; leave one of each out.")
    return sentences


def warn_once(scene, said):
    """Warns of everything in :func:`unsupported` that is not in the set ``said``, and adds it there."""
    # Faces are looked at once per shape, as that costs more than all the rest.
    new = [shape for shape in scene.shapes() if shape.is_mesh() and ("faces", shape.id()) not in said]
    said.update(("faces", shape.id()) for shape in new)
    for sentence in [*unsupported(scene), *repeated_faces(new)]:
        if sentence not in said:
            said.add(sentence)
            warnings.warn(sentence, RuntimeWarning, stacklevel=2)
