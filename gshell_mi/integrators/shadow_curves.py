"""The curves on the film along which edges cut off light: from points on edges to what a camera sees."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .edge_wedges import EdgeWedges, silhouette_for
from .shadow_edges import ShadowSamples
from .silhouette_edges import project_to_film

#: Share of the points that are tried as the place where a mesh turns away from the light
_TURNING = 0.2

#: How far beside edges light passes, and how deep in their wedges it is stopped, in units of ``_scale``. Many
#: edges of a fine mesh that light grazes lie within 1e-4 of one line, and only the outermost counts; but what
#: misses the wedge by rounding, seen from a distant shadow, must not count as light.
_BESIDE, _INSIDE = 2e-6, 4e-5

#: Sine of half the angle of a wedge; in sharper ones, points are nearer to the sides.
_SHARPEST = 1e-2


@dataclass
class ShadowPoints:
    """Shadows of points on edges, or edge points at which a mesh turns away from the light."""

    visible: mi.Point3f  #: attached: what a camera may see
    lit: mi.Point3f  #: where the light arrives
    y: mi.Point3f  #: the point beside the edge
    along: mi.Vector3f  #: derivative of ``visible`` along the edge
    across: mi.Vector3f  #: derivative of ``visible`` for a unit motion towards the light
    valid: mi.Bool
    via: mi.Vector3f | None  #: direction from ``visible`` to ``lit`` if these differ


class ShadowCurves:
    """Follows points on edges along the light that they cut off.

    Args:
        scene, sensor: the scene, and a perspective sensor.
        wedges: the ``EdgeWedges`` of the scene.
    """

    def __init__(self, scene: mi.Scene, sensor: mi.Sensor, wedges: EdgeWedges) -> None:
        self.scene, self.sensor, self.wedges = scene, sensor, wedges
        self.to_camera = dr.detach(sensor.world_transform()).inverse()
        self.viewpoint = mi.Point3f(dr.detach(sensor.world_transform()).translation())

    def place(self, drawn: ShadowSamples) -> tuple[mi.Bool, mi.Vector3f, mi.Bool]:
        """Decides for each point whether it is to cast a shadow, and corrects the weights for that.

        The other points are those where the visible side of a mesh turns away from the light: shading
        normals do so elsewhere, so the light jumps at the edge. Not so where the film warp follows it.
        """
        p, q, axis, inward, across = self.wedges.frame(drawn.edge)
        low, high = (
            dr.gather(mi.Float, self.wedges.low, drawn.edge),
            dr.gather(mi.Float, self.wedges.high, drawn.edge),
        )
        y = dr.lerp(p, q, drawn.t)
        towards = drawn.towards(y)
        middle = 0.5 * (low + high)
        outward = dr.normalize(dr.cross(axis, towards))
        outward *= -dr.sign(dr.dot(outward, inward * dr.cos(middle) + across * dr.sin(middle)))
        seen_as_silhouette = silhouette_for(self.viewpoint - y, inward, across, low, high)
        can_turn = ~seen_as_silhouette & ~dr.gather(mi.Bool, self.wedges.crease, drawn.edge)
        cast = ~can_turn | (drawn.kind >= _TURNING)
        share = dr.select(can_turn, dr.select(cast, 1 - _TURNING, _TURNING), mi.Float(1))
        drawn.weight = drawn.weight / share
        valid = dr.isfinite(dr.squared_norm(outward)) & (drawn.weight > 0)
        return cast, mi.Vector3f(outward * (_BESIDE * _scale(y))), valid

    def follow(
        self, positions: mi.Float, drawn: ShadowSamples, cast: mi.Bool, outward: mi.Vector3f, bounce: int
    ) -> ShadowPoints:
        """From points on edges to what a camera may see of their shadow."""
        wedges = self.wedges
        a, b = (
            dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, x, drawn.edge))
            for x in (wedges.start, wedges.end)
        )
        y = mi.Point3f(dr.lerp(a, b, drawn.t)) + outward
        towards = drawn.towards(y)
        shadow, normal, valid = self._next_surface(y, -towards, 0, cast)
        with dr.suspend_grad():
            y_now, along, across = dr.detach(y), dr.detach(b - a), dr.normalize(outward)
            now = dr.detach(towards)
            scale = mi.Float(1)
            if drawn.is_point:
                z = mi.Point3f(drawn.position)
                scale = dr.norm(dr.detach(shadow) - z) / dr.norm(y_now - z)
            along = dr.select(cast, _slide(along, normal, now) * scale, along)
            across = dr.select(cast, _slide(across, normal, now) * scale, self._lit_side(drawn, now))
        p = dr.select(cast, shadow, y - outward)
        lit, valid = dr.detach(p), valid | ~cast
        via = None
        if bounce:
            via = mi.warp.square_to_uniform_sphere(drawn.via)
            p, normal, hit = self._next_surface(p, -via, 1e-4 * _scale(lit), valid)
            along, across = (_slide(x, normal, via) for x in (along, across))
            valid &= hit
        return ShadowPoints(mi.Point3f(p), mi.Point3f(lit), y_now, along, across, valid, via)

    def _lit_side(self, drawn: ShadowSamples, towards: mi.Vector3f) -> mi.Vector3f:
        """Unit vectors from edges into the face that is turned to the light."""
        _, _, _, inward, across = self.wedges.frame(drawn.edge)
        high = dr.gather(mi.Float, self.wedges.high, drawn.edge)
        outer = across * dr.cos(high) - inward * dr.sin(high)
        angle = dr.select(dr.dot(outer, towards) > 0, high, dr.gather(mi.Float, self.wedges.low, drawn.edge))
        return inward * dr.cos(angle) + across * dr.sin(angle)

    def _into(self, edge: mi.UInt32) -> mi.Vector3f:
        """Vectors into the wedges of edges, to points a unit away from both sides."""
        _, _, _, inward, across = self.wedges.frame(edge)
        low, high = (dr.gather(mi.Float, x, edge) for x in (self.wedges.low, self.wedges.high))
        middle = 0.5 * (low + high)
        length = dr.rcp(dr.maximum(dr.sin(0.5 * (high - low)), _SHARPEST))
        return (inward * dr.cos(middle) + across * dr.sin(middle)) * length

    def _next_surface(
        self, p: mi.Point3f, direction: mi.Vector3f, lift: mi.Float | float, active: mi.Bool
    ) -> tuple[mi.Point3f, mi.Normal3f, mi.Bool]:
        """The next surface from points along a direction: position, attached; normal; whether any."""
        ray = mi.Ray3f(mi.Point3f(p + direction * lift), direction)
        with dr.suspend_grad():
            pi = self.scene.ray_intersect_preliminary(dr.detach(ray), active=active)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal)
        return mi.Point3f(si.p), dr.detach(si.n), pi.is_valid() & active

    def film_vectors(self, followed: ShadowPoints) -> tuple[mi.Vector2f, mi.Float, mi.Float]:
        """Derivative of the film position along the edge; the film area that a unit motion across it
        sweeps; and the sign of the side on which there is light."""
        p = mi.Point3f(dr.detach(followed.visible))
        tangent, across = (self._on_film(p, x) for x in (followed.along, followed.across))
        cross = tangent.x * across.y - tangent.y * across.x
        area = dr.abs(cross)
        return tangent, dr.select(dr.isfinite(area), area, 0), dr.sign(cross)

    def _on_film(self, p: mi.Point3f, direction: mi.Vector3f) -> mi.Vector2f:
        """Derivative of the film position of points along a direction."""
        distance, length = dr.norm(p - self.viewpoint), dr.norm(direction)
        step = 1e-2 * distance / dr.maximum(length, 1e-20)
        moved = mi.Point3f(p + direction * step)
        # A straight line stays one, so only the scale of a finite step needs mending.
        scale = (self.to_camera @ moved).z / (self.to_camera @ p).z
        offset = project_to_film(self.sensor, moved) - project_to_film(self.sensor, p)
        return mi.Vector2f(offset) * (scale / step)

    def rays(
        self, drawn: ShadowSamples, cast: mi.Bool, followed: ShadowPoints, outward: mi.Vector3f
    ) -> tuple[mi.Ray3f, mi.Ray3f]:
        """Rays towards the light that pass by the edge, and that its wedge stops."""
        lit = mi.Ray3f(followed.y, drawn.towards(followed.y))
        # Straight in from a sharp edge would be out again on the other side.
        into = dr.select(
            cast,
            -dr.normalize(outward) * dr.maximum(_scale(followed.lit), _scale(followed.y)),
            self._into(drawn.edge) * _scale(followed.y),
        )
        inside = followed.y - outward + _INSIDE * into
        origin = dr.select(cast, followed.lit, inside)
        direction = dr.select(cast, dr.normalize(inside - followed.lit), drawn.towards(inside))
        origin += direction * dr.select(cast, 1e-4 * _scale(origin), 0)
        return lit, mi.Ray3f(mi.Point3f(origin), direction)


def _scale(p: mi.Point3f) -> mi.Float:
    """What rounding errors of points are in proportion to."""
    return 1 + dr.max(dr.abs(p))


def _slide(vector: mi.Vector3f, normal: mi.Normal3f, along: mi.Vector3f) -> mi.Vector3f:
    """The vector projected along a direction on the plane with the given normal."""
    return vector - along * (dr.dot(normal, vector) / dr.dot(normal, along))
