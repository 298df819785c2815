"""One picture of an object: path traced, or a channel of its material as it is."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from ..material import principled

_Shade: TypeAlias = """Callable[[mi.SurfaceInteraction3f, mi.PreliminaryIntersection3f, mi.Float],
                              tuple[mi.Color3f, mi.Float]]"""

#: Back faces of the open mesh, linear Rec.709: the orange of the G-Shell paper's figures.
ORANGE = (0.9, 0.32, 0.03)

#: What a picture can show. ``shaded`` is the object, ``geometry`` its shape in grey under the same light; the
#: rest is shown unlit, normals as (n + 1) / 2 in world space.
CHANNELS = ("shaded", "geometry", "base_color", "roughness", "metallic", "normal")

_ATTRIBUTES = {"base_color": "vertex_color", "roughness": "vertex_roughness", "metallic": "vertex_metallic"}
_GREY = 0.5
_WIRE_PIXELS = 0.5
_CAST_SAMPLES = 16


def denoiser_available() -> bool:
    """Whether Open Image Denoise is installed (``pip install gshell_mi[denoise]``)."""
    return importlib.util.find_spec("mitsuba_oidn") is not None


@dataclass(frozen=True)
class Look:
    """How an object is shown.

    Attributes:
        channel: one of ``CHANNELS``.
        orange_back: paint the side that normals point away from.
        wireframe: draw the edges of the triangles.
    """

    channel: str = "shaded"
    orange_back: bool = False
    wireframe: bool = False


class Studio:
    """An object under a light, seen in one look.

    Args:
        mesh_file: PLY with the attributes of ``material.ATTRIBUTES``.
        light: emitter.
        look: what is shown.
        spp: samples per pixel of path-traced looks.
        max_depth: longest path.
        denoise: filter path-traced pictures with Open Image Denoise.
    """

    def __init__(
        self,
        mesh_file: Path,
        light: mi.Emitter,
        look: Look,
        *,
        spp: int = 32,
        max_depth: int = 5,
        denoise: bool = False,
    ):
        self.look, self._spp, self._denoise = look, spp, denoise
        front = {"type": "diffuse", "reflectance": {"type": "rgb", "value": _GREY}}
        if look.channel == "shaded":
            front = principled()["bsdf"]
        bsdf = {"type": "twosided", "front": front}
        if look.orange_back:
            bsdf["back"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(ORANGE)}}
        self._scene = mi.load_dict(
            {
                "type": "scene",
                "light": light,
                "subject": {"type": "ply", "filename": str(mesh_file), "bsdf": bsdf},
            }
        )
        self._integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "hide_emitters": True})

    def render(self, sensor: mi.Sensor, seed: int = 0) -> np.ndarray:
        """(h, w, 4) linear, premultiplied by alpha."""
        if self.look.channel in ("shaded", "geometry"):
            image = np.array(
                mi.render(self._scene, sensor=sensor, integrator=self._integrator, spp=self._spp, seed=seed)
            )
            if self._denoise:
                image[..., :3] = _denoised(image[..., :3])
            if not self.look.wireframe:
                return image
            return _over(image, self._cast(sensor, seed, self._wires))
        image = self._cast(sensor, seed, self._unlit)
        return _over(image, self._cast(sensor, seed, self._wires)) if self.look.wireframe else image

    def _cast(self, sensor: mi.Sensor, seed: int, shade: _Shade) -> np.ndarray:
        """Means over each pixel of ``shade(surface interaction, preliminary interaction, pixel size)``."""
        width, height = sensor.film().crop_size()
        count = width * height * _CAST_SAMPLES
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, count)
        pixel = dr.arange(mi.UInt32, count) // _CAST_SAMPLES
        corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
        film = (corner + sampler.next_2d()) / mi.Point2f(width, height)
        ray, _ = sensor.sample_ray(0.0, 0.5, film, mi.Point2f(0.5))
        preliminary = self._scene.ray_intersect_preliminary(ray)
        si = preliminary.compute_surface_interaction(ray)
        fov = float(np.ravel(mi.traverse(sensor)["x_fov"])[0])
        pixel_size = si.t * (2 * np.tan(np.radians(fov) / 2) / width)
        color, alpha = shade(si, preliminary, pixel_size)
        valid = si.is_valid()
        channels = [dr.select(valid, x * alpha, 0) for x in color] + [dr.select(valid, alpha, 0)]
        means = [np.array(dr.block_sum(x, _CAST_SAMPLES)) / _CAST_SAMPLES for x in channels]
        return np.stack(means, axis=-1).reshape(height, width, 4)

    def _unlit(
        self, si: mi.SurfaceInteraction3f, preliminary: mi.PreliminaryIntersection3f, pixel_size: mi.Float
    ) -> tuple[mi.Color3f, mi.Float]:
        shape = self._scene.shapes()[0]
        if self.look.channel == "normal":
            color = mi.Color3f(0.5 * si.sh_frame.n + 0.5)
        elif self.look.channel == "base_color":
            color = shape.eval_attribute_3(_ATTRIBUTES[self.look.channel], si)
        else:
            color = mi.Color3f(shape.eval_attribute_1(_ATTRIBUTES[self.look.channel], si))
        if self.look.orange_back:
            color = dr.select(dr.dot(si.n, si.to_world(si.wi)) < 0, mi.Color3f(ORANGE), color)
        return color, mi.Float(1)

    def _wires(
        self, si: mi.SurfaceInteraction3f, preliminary: mi.PreliminaryIntersection3f, pixel_size: mi.Float
    ) -> tuple[mi.Color3f, mi.Float]:
        """Black along the edges: the distance to the nearest one against the size of a pixel there."""
        shape = self._scene.shapes()[0]
        prim = dr.select(preliminary.is_valid(), preliminary.prim_index, 0)
        a, b, c = (shape.vertex_position(i) for i in shape.face_indices(prim))
        doubled_area = dr.norm(dr.cross(b - a, c - a))
        u, v = preliminary.prim_uv
        distance = dr.inf
        for weight, opposite in ((1 - u - v, c - b), (u, a - c), (v, b - a)):
            distance = dr.minimum(distance, weight * doubled_area / dr.norm(opposite))
        return mi.Color3f(0), dr.select(distance < 0.5 * _WIRE_PIXELS * pixel_size, 1.0, 0.0)


def _over(image: np.ndarray, above: np.ndarray) -> np.ndarray:
    return above + image * (1 - above[..., 3:])


def _denoised(color: np.ndarray) -> np.ndarray:
    import mitsuba_oidn  # pyright: ignore[reportMissingImports]  # an extra

    return np.asarray(mitsuba_oidn.denoise(np.ascontiguousarray(color, np.float32), hdr=True))
