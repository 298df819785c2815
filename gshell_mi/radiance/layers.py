"""The layers of a template that rays meet one behind the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from .lanes import chosen_lanes

_Value = TypeVar("_Value")


def interpolated(
    kind: type[_Value],
    values: mi.Float,
    vertices: Iterable[mi.UInt32],
    weights: Iterable[mi.Float],
    active: bool | mi.Bool = True,
) -> _Value:
    """Values of a ``kind``, interleaved in ``values``, of three vertices, by barycentric weights."""
    mean: Any = 0
    for vertex, weight in zip(vertices, weights, strict=True):
        mean += weight * dr.gather(kind, values, vertex, active)
    return mean


@dataclass
class Layer:
    """Where rays meet a template for the first time, the second, and so on; one lane per ray that does.

    Attributes:
        lane: of the ray among those of the layer in front; among all rays for the first.
        origin, direction: of the ray; the origin lies behind the layer in front.
        face: vertex indices of the triangle.
        weights: barycentric.
        front: whether the ray comes from the side that the triangle's normal points to.
    """

    lane: mi.UInt32
    origin: mi.Point3f
    direction: mi.Vector3f
    face: mi.Vector3u
    weights: mi.Vector3f
    front: mi.Bool

    def interpolate(self, values: mi.Float) -> mi.Float:
        """One value per vertex at the hits."""
        return interpolated(mi.Float, values, self.face, self.weights)

    def side(self, corner: mi.UInt32) -> mi.UInt32:
        """Of a corner, the place of the side that is seen among values (V, 2): front, then back."""
        return 2 * corner + dr.select(self.front, mi.UInt32(0), mi.UInt32(1))


def trace_layers(
    scene: mi.Scene,
    positions: mi.Float,
    faces: mi.Vector3u,
    ray: mi.Ray3f,
    count: int,
    offset: float,
    goes_on: Callable[[Layer], mi.Bool] | None = None,
) -> list[Layer]:
    """The first layers along each ray.

    Only the rays that go on are traced any further, and only hits have lanes: of a closed template every ray
    that hits has a second layer, but few have a fourth.

    Args:
        scene: of the template alone.
        positions: (3 V,) of its vertices.
        faces: its triangles.
        ray: to follow.
        count: of layers, at most.
        offset: between a layer and where its ray goes on, world units.
        goes_on: of a layer, which of its rays pass it; None for all.
    """
    layers, behind = [], dr.opaque(mi.Float, offset)
    origin, direction, active = ray.o, ray.d, mi.Bool(True)
    for _ in range(count):
        hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=False, active=active)
        values = origin, direction, hit.t, hit.prim_uv, hit.prim_index
        lane = chosen_lanes(hit.is_valid(), values)
        if not dr.width(lane):
            break
        origin, direction, t, uv, prim = (dr.gather(type(value), value, lane) for value in values)
        face = dr.gather(mi.Vector3u, faces, prim)
        a, b, c = (dr.gather(mi.Point3f, positions, corner) for corner in face)
        front = dr.dot(dr.cross(b - a, c - a), direction) < 0
        layer = Layer(lane, origin, direction, face, mi.Vector3f(1 - uv.x - uv.y, uv.x, uv.y), front)
        layers.append(layer)
        active = goes_on(layer) if goes_on else mi.Bool(True)
        origin = mi.Point3f(origin + direction * (t + behind))
        dr.eval(layer, origin, direction, active)
    return layers
