"""Everything that depends on the versions and the quirks of other packages, in one place."""

from __future__ import annotations

import errno
import os
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

#: Major and minor version of Dr.Jit.
DRJIT_VERSION = tuple(int(part) for part in dr.__version__.split(".")[:2])

#: Integrators that Mitsuba registers from Python; all its other plugins are libraries in its folder.
MITSUBA_INTEGRATORS = (
    "prb",
    "prb_basic",
    "prb_projective",
    "prbvolpath",
    "direct_projective",
    "volprim_rf_basic",
)


def mitsuba_folder() -> Path:
    """Where Mitsuba is installed, with its own plugins in ``plugins``."""
    return Path(mi.__file__).resolve().parent


def trust_only_own_plugins() -> None:
    """Puts Mitsuba's folder in front of its resource path, where it looks for plugins by name.

    Otherwise ``plugins/path.so`` in the folder of a scene, or in the current one, would be taken for
    Mitsuba's integrator, and run.
    """
    resolver, own = mi.file_resolver(), mitsuba_folder()
    if Path(str(resolver[0])).resolve() != own:
        resolver.prepend(str(own))


_silence = threading.RLock()


@contextmanager
def without_chatter() -> Iterator[None]:
    """Drops what native libraries print meanwhile: OpenEXR writes of a damaged file, and raises too."""
    with _silence, ExitStack() as stack:
        for stream, number in ((sys.stdout, 1), (sys.stderr, 2)):
            try:
                stream.flush()
                kept = os.dup(number)
            except (OSError, ValueError, AttributeError):  # closed: there is nobody to disturb
                continue
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, number)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, number)
            os.close(nowhere)
        yield


def environment_data(radiance: mi.TensorXf) -> mi.TensorXf:
    """The ``data`` parameter of an ``envmap`` emitter for an image of shape (height, width, 3).

    Mitsuba 3.9 stores one column more on either side, copies of the opposite ones, so that bilinear
    lookups wrap around. Differentiable.
    """
    height, width, channels = radiance.shape
    index = dr.arange(mi.UInt32, height * (width + 2) * channels)
    channel = index % channels
    column = (index // channels) % (width + 2)
    row = index // (channels * (width + 2))
    source = (row * width + (column + width - 1) % width) * channels + channel
    return mi.TensorXf(dr.gather(mi.Float, radiance.array, source), (height, width + 2, channels))


def environment_radiance(emitter: mi.Emitter) -> np.ndarray:
    """(height, width, 3) radiance of an ``envmap`` emitter: the inverse of ``environment_data``."""
    parameters = mi.traverse(emitter)
    return np.array(parameters["data"])[:, 1:-1, :3] * np.array(parameters["scale"]).ravel()


def init_mesh(mesh: mi.Mesh, props: mi.Properties, has_vertex_normals: bool) -> None:
    """Constructs a Python subclass of ``mi.Mesh`` as one triangle, to be filled by ``write_mesh``."""
    mi.Mesh.__init__(mesh, props.plugin_name(), 3, 1, props, has_vertex_normals)


def to_world(props: mi.Properties) -> mi.ScalarTransform4f:
    """The property ``to_world``, which Mitsuba hands out in double precision, or the identity."""
    return mi.ScalarTransform4f(props.get("to_world", mi.ScalarTransform4f()).matrix)


def write_mesh(
    mesh: mi.Mesh,
    positions: mi.Float,
    faces: mi.UInt32,
    normals: mi.Float | None = None,
    **attributes: mi.Float,
) -> list[str]:
    """Replaces the buffers of a mesh, whose sizes may change, and lets it update itself.

    Args:
        positions, normals: flat ``mi.Float`` of 3 values per vertex.
        faces: flat ``mi.UInt32`` of 3 indices per face.
        attributes: flat ``mi.Float`` per attribute that the mesh has.
    """
    values = {"vertex_positions": positions, "faces": faces}
    if normals is not None:
        # Given in the same update, they replace those that Mitsuba would compute.
        values["vertex_normals"] = normals
    return write_parameters(mesh, values | attributes)


def write_parameters(node: mi.Object, values: Mapping[str, Any]) -> list[str]:
    """Replaces those parameters of a mesh or scene that are named, and lets it update itself."""
    params = mi.traverse(node)
    for name, value in values.items():
        params[name] = value
    return params.update()


def drop_vertex_normals(mesh: mi.Mesh) -> None:
    """Leaves a mesh without vertex normals, so that it is shaded with those of its faces."""
    write_parameters(mesh, {"vertex_normals": mi.Float([])})


def triangle_mesh(name: str, vertices: np.ndarray, faces: np.ndarray) -> mi.Mesh:
    """A mesh of (V, 3) positions and (F, 3) indices, shaded with face normals."""
    mesh = mi.Mesh(name, len(vertices), len(faces))
    write_mesh(
        mesh,
        mi.Float(np.ascontiguousarray(vertices, np.float32).ravel()),
        mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel()),
    )
    return mesh


def mesh_scene(vertices: np.ndarray, faces: np.ndarray) -> mi.Scene:
    """A scene of just that mesh for its rays, to be moved by ``move_mesh``.

    The mesh is an instance: on the CPU, Mitsuba splits triangles for the BVH of a scene, but not for that
    of a group, which is built three times as fast; rays are as fast in either.
    """
    return mi.load_dict(
        {
            "type": "scene",
            "group": {"type": "shapegroup", "mesh": triangle_mesh("mesh", vertices, faces)},
            "instance": {"type": "instance", "shapegroup": {"type": "ref", "id": "group"}},
        }
    )


def move_mesh(scene: mi.Scene, positions: mi.Float) -> None:
    """Puts the vertices of a ``mesh_scene`` elsewhere: (3 V,) positions, x0, y0, z0, x1, ..."""
    write_parameters(scene, {"group.mesh.vertex_positions": positions})


def write_bitmap(bitmap: mi.Bitmap, path: Path) -> None:
    """Writes an image by its suffix; unlike Mitsuba's error, its ``OSError`` says what is wrong and where."""
    try:
        bitmap.write(str(path))
    except RuntimeError as error:
        raise OSError(errno.EIO, str(error).rpartition(": ")[2], str(path)) from error


def colour_science() -> ModuleType:
    """The package colour-science, imported when first needed, as that takes a second.

    It changes how NumPy prints and warns of packages that it would use for plots; both are undone.
    """
    with np.printoptions(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    return colour
