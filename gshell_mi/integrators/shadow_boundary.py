"""The derivative of what the first visible surfaces receive, where edges cut it off.

For a fixed direction ``ω`` (or a fixed point of a light) the reflected light ``F(u)`` is a function on
the film. It jumps along the curves on which the silhouette edges for ``ω`` cast their shadow on what
the camera sees. By Reynolds' theorem those curves add

    sum over edges, integral over t of  h(c) (F_left - F_right) cross(dc/dθ, dc/dt)

to the derivative of a pixel with filter ``h``, where ``c(t, θ)`` is the film position of the shadow of
the edge point ``t``. Writing the boundary term on the film needs no further Jacobians: ``c`` is an
edge point, projected along ``ω`` on the receiver and from there on the film, all attached.

Many more points are tried than used: what the camera does not see or no light reaches is dropped, and
the rest is thinned out (importance resampling, Talbot et al. 2005) in proportion to the size of the
jump times the area on the film that a unit motion of the edge sweeps.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .edge_wedges import build_edge_wedges, silhouette_for
from .reparameterised_film import film_channels
from .resampling import systematic_counts
from .shadow_edges import draw_directions, draw_emitters, draw_map_directions
from .silhouette_edges import project_to_film

#: Points tried per point used
CANDIDATES = 4

#: Share of the points that are tried as the place where a mesh turns away from the light
_TURNING = 0.2

#: Light that surfaces send, for the importance of points that no emitter reaches, in units of the mean
_INDIRECT = 0.2


@dataclass
class BoundaryTerm:
    """Points on curves of the film at which the integrand jumps."""

    moving: object      #: ``Point2f``, attached: position in pixels relative to the crop window
    tangent: object     #: ``Vector2f``: its derivative along the edge
    weight: object      #: ``Float``
    jump: object        #: per film channel, the value on the left of the tangent less the other

    @property
    def film(self):
        """The present position."""
        return dr.detach(self.moving)

    def swept(self, warp):
        """Weighted area that the curve sweeps over the film, relative to the warp; attached."""
        shifted, _ = warp(self.film)
        motion = mi.Vector2f(self.moving - shifted)
        return self.weight * (self.tangent.y * motion.x - self.tangent.x * motion.y)


def boundary_terms(integrator, scene, tables, sensor, seed):
    """Yields the :class:`BoundaryTerm` of each kind of light, and of each depth it is seen at.

    ``integrator``: a ``gshell_path``; its ``reparam_depth``, ``max_depth``, ``light_edge_samples`` and
    ``crease_angle`` are honoured.
    """
    depth = min(integrator.reparam_depth, integrator.max_depth)
    wedges = build_edge_wedges(tables, integrator.crease_angle) if depth > 1 else None
    if wedges is None:
        return
    samples = max(int(dr.prod(sensor.film().crop_size()) * integrator.light_edge_samples), 1)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, 8)

    def shifts():
        x = sampler.next_1d()
        dr.eval(x)
        return x

    draws = []
    if scene.environment() is not None or integrator.max_depth > 2:
        draws += [draw_directions(scene, wedges, samples * CANDIDATES, shifts()),
                  draw_map_directions(scene, wedges, samples * CANDIDATES, shifts())]
    draws += draw_emitters(scene, wedges, samples * CANDIDATES, shifts())
    boundary = _Boundary(integrator, scene, sensor, wedges)
    for drawn in draws:
        if drawn is None:
            continue
        for bounce in range(depth - 1):
            term = boundary.term(drawn, bounce, samples, sampler)
            if term is not None:
                yield term


class _Boundary:
    """Follows edge points to the film and measures the jump there."""

    def __init__(self, integrator, scene, sensor, wedges):
        self.integrator, self.scene, self.sensor, self.wedges = integrator, scene, sensor, wedges
        self.to_camera = dr.detach(sensor.world_transform()).inverse()
        self.viewpoint = mi.Point3f(dr.detach(sensor.world_transform()).translation())
        film = sensor.film()
        self.border = film.rfilter().border_size() if film.sample_border() else 0

    def term(self, drawn, bounce, samples, sampler):
        """The boundary term of drawn edge samples, or ``None`` if none of them is seen."""
        indirect = drawn.emitter is None and not bounce and self.integrator.max_depth > 2
        cast, outward, importance = self._importance(drawn, bounce, indirect)
        offset = sampler.next_1d()
        chosen = systematic_counts(importance, samples, dr.gather(mi.Float, offset, mi.UInt32(0)))
        if chosen is None:
            return None
        count, one_over_expected = chosen
        index = dr.compress(count > 0)
        drawn, cast = drawn.take(index), dr.gather(mi.Bool, cast, index)
        outward = dr.gather(mi.Vector3f, outward, index)
        drawn.weight *= dr.gather(mi.Float, mi.Float(count) * one_over_expected, index)
        dr.eval(drawn.arrays(), cast, outward)

        with dr.resume_grad():
            followed = self._follow(self.wedges.positions, drawn, cast, outward, bounce)
            moving = project_to_film(self.sensor, followed.visible)
        tangent, _, side = self._film_vectors(followed)
        scattered, radiance, ok = self._reflected(drawn, cast, followed, bounce)
        lit, dark = self._rays(drawn, cast, followed, outward)
        if indirect:
            lit, dark = (self.integrator.primal(self.scene, self._path_sampler(sampler, drawn), ray, ok,
                                                start=1).value for ray in (lit, dark))
            difference = lit - dark
        else:
            reaches = self._reaches(drawn, lit, followed.lit) & ~self._reaches(drawn, dark, followed.lit)
            difference = dr.select(reaches, radiance, 0)
        jump = dr.select(ok & dr.isfinite(dr.squared_norm(tangent)), scattered * difference * side, 0)
        jump = film_channels(self.sensor.film(), jump, mi.Float(0), [], mi.Color0f())
        dr.eval(jump, tangent, drawn.weight)
        return BoundaryTerm(moving, tangent, drawn.weight, jump)

    def _path_sampler(self, sampler, drawn):
        result = sampler.clone()
        result.seed(dr.opaque(mi.UInt32, int(sampler.next_1d()[0] * 2**24)), dr.width(drawn.t))
        return result

    def _importance(self, drawn, bounce, indirect):
        """Which points are those of cast shadows, the way out of each edge's wedge, and how many to use."""
        cast, outward, valid = self._place(drawn)
        followed = self._follow(dr.detach(self.wedges.positions), drawn, cast, outward, bounce)
        c = project_to_film(self.sensor, followed.visible)
        size = mi.Point2f(self.sensor.film().crop_size())
        ok = valid & followed.valid & dr.all((c > -self.border) & (c < size + self.border))
        followed.valid = ok & ((self.to_camera @ followed.visible).z > self.sensor.near_clip())
        scattered, radiance, ok = self._reflected(drawn, cast, followed, bounce)
        lit, _ = self._rays(drawn, cast, followed, outward)
        radiance = dr.select(ok & self._reaches(drawn, lit, followed.lit), radiance, 0)
        if indirect:
            radiance = dr.mean(mi.unpolarized_spectrum(radiance))
            mean = dr.mean(radiance)
            radiance = mi.Spectrum(radiance + dr.select(mean > 0, _INDIRECT * mean, 1))
        _, area, _ = self._film_vectors(followed)
        value = dr.mean(mi.unpolarized_spectrum(scattered * radiance))
        importance = dr.select(ok, drawn.weight * area * value, 0)
        dr.eval(cast, outward, importance, drawn.weight)
        return cast, outward, importance

    def _place(self, drawn):
        """Decides for each point whether it is to cast a shadow, and corrects the weights for that.

        The other points are those where the visible side of a mesh turns away from the light: shading
        normals do so elsewhere, so the light jumps at the edge. Not so where the film warp follows it.
        """
        p, q, axis, inward, across = self.wedges.frame(drawn.edge)
        low, high = dr.gather(mi.Float, self.wedges.low, drawn.edge), dr.gather(mi.Float, self.wedges.high,
                                                                                drawn.edge)
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
        lift = 4e-5 * (1 + dr.max(dr.abs(y)))
        return cast, mi.Vector3f(outward * lift), valid

    def _follow(self, positions, drawn, cast, outward, bounce):
        """From points on edges to what a camera may see of their shadow."""
        wedges = self.wedges
        a, b = (dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, x, drawn.edge))
                for x in (wedges.start, wedges.end))
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
        p = dr.select(cast, shadow, y)
        lit, valid = dr.detach(p), valid | ~cast
        via = None
        if bounce:
            via = mi.warp.square_to_uniform_sphere(drawn.via)
            p, normal, hit = self._next_surface(p, -via, 1e-4 * (1 + dr.max(dr.abs(lit))), valid)
            along, across = (_slide(x, normal, via) for x in (along, across))
            valid &= hit
        return _Followed(mi.Point3f(p), mi.Point3f(lit), y_now, along, across, valid, via)

    def _lit_side(self, drawn, towards):
        """Unit vectors from edges into the face that is turned to the light."""
        _, _, _, inward, across = self.wedges.frame(drawn.edge)
        high = dr.gather(mi.Float, self.wedges.high, drawn.edge)
        outer = across * dr.cos(high) - inward * dr.sin(high)
        angle = dr.select(dr.dot(outer, towards) > 0, high, dr.gather(mi.Float, self.wedges.low, drawn.edge))
        return inward * dr.cos(angle) + across * dr.sin(angle)

    def _next_surface(self, p, direction, lift, active):
        """The next surface from points along a direction: position, attached; normal; whether any."""
        ray = mi.Ray3f(mi.Point3f(p + direction * lift), direction)
        with dr.suspend_grad():
            pi = self.scene.ray_intersect_preliminary(dr.detach(ray), active=active)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal)
        return mi.Point3f(si.p), dr.detach(si.n), pi.is_valid() & active

    def _film_vectors(self, followed):
        """Derivative of the film position along the edge; the film area that a unit motion across it
        sweeps; and the sign of the side on which there is light."""
        p = mi.Point3f(dr.detach(followed.visible))
        tangent, across = (self._on_film(p, x) for x in (followed.along, followed.across))
        cross = tangent.x * across.y - tangent.y * across.x
        area = dr.abs(cross)
        return tangent, dr.select(dr.isfinite(area), area, 0), dr.sign(cross)

    def _on_film(self, p, direction):
        """Derivative of the film position of points along a direction."""
        distance, length = dr.norm(p - self.viewpoint), dr.norm(direction)
        step = 1e-2 * distance / dr.maximum(length, 1e-20)
        moved = mi.Point3f(p + direction * step)
        # A straight line stays one, so only the scale of a finite step needs mending.
        scale = (self.to_camera @ moved).z / (self.to_camera @ p).z
        offset = project_to_film(self.sensor, moved) - project_to_film(self.sensor, p)
        return mi.Vector2f(offset) * (scale / step)

    def _reflected(self, drawn, cast, followed, bounce):
        """What the camera sees per light at the boundary; the emitter's light; whether it is seen at all."""
        film = self.sensor.film()
        visible, tolerance = dr.detach(followed.visible), 1e-3
        if not bounce:    # on the face that the light reaches
            visible = dr.select(cast, visible, visible + 1e-2 * dr.norm(followed.along) * followed.across)
        u = project_to_film(self.sensor, visible) / mi.Vector2f(film.crop_size())
        ray, throughput = self.sensor.sample_ray(self.sensor.shutter_open(), 0.0, u, mi.Point2f(0.5))
        si = self.integrator._first_hit(self.scene, ray, followed.valid).compute_surface_interaction(
            ray, mi.RayFlags.All, followed.valid)
        ok = followed.valid & si.is_valid() & (dr.norm(si.p - visible) < tolerance * si.t)
        context = mi.BSDFContext()
        if bounce:
            throughput = throughput * si.bsdf().eval(context, si, si.to_local(followed.via), ok)
            target = dr.select(cast, followed.lit, followed.lit + 1e-2 * dr.norm(followed.along) *
                               followed.across)
            d = dr.normalize(target - si.p)
            si = self.scene.ray_intersect(si.spawn_ray(d), ok)
            ok &= si.is_valid() & (dr.norm(si.p - target) < tolerance * si.t)
            throughput *= 4 * dr.pi
        direction, radiance = self._light(drawn, si, ok)
        scattered = throughput * si.bsdf().eval(context, si, si.to_local(direction), ok)
        return scattered, radiance, ok

    def _light(self, drawn, si, active):
        """Direction and radiance (times the geometry term, for points) of unoccluded light."""
        direction = drawn.towards(si.p)
        if drawn.emitter is None:
            environment = self.scene.environment()
            if environment is None:
                return direction, mi.Spectrum(0)
            sky = dr.zeros(mi.SurfaceInteraction3f, dr.width(drawn.t))
            sky.wi = -direction
            return direction, environment.eval(sky, active)
        if not drawn.is_point:
            return direction, drawn.emitter.sample_direction(si, mi.Point2f(0.5), active)[1]
        ds = dr.zeros(mi.DirectionSample3f, dr.width(drawn.t))
        ds.p, ds.d = mi.Point3f(drawn.position), direction
        ds.dist = dr.norm(ds.p - si.p)
        ds.emitter = mi.EmitterPtr(drawn.emitter)
        geometry = mi.Float(1)
        if drawn.normal is not None:
            ds.n, ds.uv = drawn.normal, drawn.uv
            geometry = dr.abs_dot(ds.n, ds.d) / dr.square(ds.dist)
        return direction, drawn.emitter.eval_direction(si, ds, active) * geometry

    def _rays(self, drawn, cast, followed, outward):
        """Rays towards the light that pass by the edge, and that its wedge stops."""
        lit = mi.Ray3f(followed.y, drawn.towards(followed.y))
        inside = followed.y - 2 * outward
        origin = dr.select(cast, followed.lit, inside)
        direction = dr.select(cast, dr.normalize(inside - followed.lit), drawn.towards(inside))
        origin += direction * dr.select(cast, 1e-4 * (1 + dr.max(dr.abs(origin))), 0)
        return lit, mi.Ray3f(mi.Point3f(origin), direction)

    def _reaches(self, drawn, ray, lit):
        """Whether rays meet nothing on their way to the light."""
        ray = mi.Ray3f(ray)
        if drawn.is_point:
            ray.maxt = dr.norm(mi.Point3f(drawn.position) - ray.o) * (1 - 1e-3)
        return ~self.scene.ray_test(ray)


@dataclass
class _Followed:
    visible: object     #: ``Point3f``, attached: what a camera may see
    lit: object         #: ``Point3f``: where the light arrives
    y: object           #: ``Point3f``: the point beside the edge
    along: object       #: ``Vector3f``: derivative of ``visible`` along the edge
    across: object      #: ``Vector3f``: derivative of ``visible`` for a unit motion towards the light
    valid: object       #: ``Bool``
    via: object         #: ``Vector3f``: direction from ``visible`` to ``lit`` if these differ


def _slide(vector, normal, along):
    """The vector projected along a direction on the plane with the given normal."""
    return vector - along * (dr.dot(normal, vector) / dr.dot(normal, along))
