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

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..means import channel_mean, mean
from .edge_table import EdgeTable
from .edge_wedges import EdgeWedges, build_edge_wedges
from .reparameterised_film import Warp, film_channels
from .resampling import systematic_counts
from .shadow_curves import ShadowCurves, ShadowPoints
from .shadow_edges import ShadowSamples, draw_directions, draw_emitters, draw_map_directions
from .silhouette_edges import project_to_film

if TYPE_CHECKING:
    from .gshell_path import GShellPathIntegrator

#: Points tried per point used
CANDIDATES = 4

#: Light that surfaces send, for the importance of points that no emitter reaches, in units of the mean
_INDIRECT = 0.2


@dataclass
class BoundaryTerm:
    """Points on curves of the film at which the integrand jumps."""

    moving: mi.Point2f  #: attached: position in pixels relative to the crop window
    tangent: mi.Vector2f  #: its derivative along the edge
    weight: mi.Float
    jump: list[mi.Float]  #: per film channel, the value on the left of the tangent less the other

    @property
    def film(self) -> mi.Point2f:
        """The present position."""
        return dr.detach(self.moving)

    def swept(self, warp: Warp) -> mi.Float:
        """Weighted area that the curve sweeps over the film, relative to the warp; attached."""
        shifted, _ = warp(self.film)
        motion = mi.Vector2f(self.moving - shifted)
        return self.weight * (self.tangent.y * motion.x - self.tangent.x * motion.y)


def boundary_terms(
    integrator: GShellPathIntegrator,
    scene: mi.Scene,
    tables: list[tuple[mi.Mesh, EdgeTable]],
    sensor: mi.Sensor,
    seed: int,
) -> Iterator[BoundaryTerm]:
    """Yields the ``BoundaryTerm`` of each kind of light, and of each depth it is seen at.

    ``integrator``: a ``gshell_path``; its ``reparam_depth``, ``gradient_depth``, ``light_edge_samples`` and
    ``crease_angle`` are honoured.
    """
    depth = min(integrator.reparam_depth, integrator.gradient_depth)
    wedges = build_edge_wedges(tables, integrator.crease_angle) if depth > 1 else None
    if wedges is None:
        return
    samples = max(int(dr.prod(sensor.film().crop_size()) * integrator.light_edge_samples), 1)
    sampler = mi.load_dict({"type": "independent"})
    # Not the numbers that the camera's first samples are of.
    sampler.seed(mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(3))[0], 8)

    def shifts() -> mi.Float:
        x = sampler.next_1d()
        dr.eval(x)
        return x

    draws = []
    if scene.environment() is not None or integrator.gradient_depth > 2:
        draws += [
            draw_directions(scene, wedges, samples * CANDIDATES, shifts()),
            draw_map_directions(scene, wedges, samples * CANDIDATES, shifts()),
        ]
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

    def __init__(
        self, integrator: GShellPathIntegrator, scene: mi.Scene, sensor: mi.Sensor, wedges: EdgeWedges
    ) -> None:
        self.integrator, self.scene, self.sensor, self.wedges = integrator, scene, sensor, wedges
        self.curves = ShadowCurves(scene, sensor, wedges)
        film = sensor.film()
        self.border = film.rfilter().border_size() if film.sample_border() else 0

    def term(
        self, drawn: ShadowSamples, bounce: int, samples: int, sampler: mi.Sampler
    ) -> BoundaryTerm | None:
        """The boundary term of drawn edge samples, or ``None`` if none of them is seen or nothing moves."""
        indirect = drawn.emitter is None and not bounce and self.integrator.gradient_depth > 2
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
            followed = self.curves.follow(self.wedges.positions, drawn, cast, outward, bounce)
            moving = project_to_film(self.sensor, followed.visible)
            if not dr.grad_enabled(moving):  # as where only materials and lights are sought
                return None
        tangent, _, side = self.curves.film_vectors(followed)
        scattered, radiance, ok = self._reflected(drawn, cast, followed, bounce)
        lit, dark = self.curves.rays(drawn, cast, followed, outward)
        if indirect:
            lit, dark = (
                self.integrator.primal(self.scene, self._path_sampler(sampler, drawn), ray, ok, start=1).value
                for ray in (lit, dark)
            )
            difference = lit - dark
        else:
            reaches = self._reaches(drawn, lit, followed.lit) & ~self._reaches(drawn, dark, followed.lit)
            difference = dr.select(reaches, radiance, 0)
        jump = dr.select(ok & dr.isfinite(dr.squared_norm(tangent)), scattered * difference * side, 0)
        jump = film_channels(self.sensor.film(), jump, mi.Float(0), [], mi.Color0f())
        dr.eval(jump, tangent, drawn.weight)
        return BoundaryTerm(moving, tangent, drawn.weight, jump)

    def _path_sampler(self, sampler: mi.Sampler, drawn: ShadowSamples) -> mi.Sampler:
        result = sampler.clone()
        result.seed(dr.opaque(mi.UInt32, int(sampler.next_1d()[0] * 2**24)), dr.width(drawn.t))
        return result

    def _importance(
        self, drawn: ShadowSamples, bounce: int, indirect: bool
    ) -> tuple[mi.Bool, mi.Vector3f, mi.Float]:
        """Which points are those of cast shadows, the way out of each edge's wedge, and how many to use."""
        cast, outward, valid = self.curves.place(drawn)
        followed = self.curves.follow(dr.detach(self.wedges.positions), drawn, cast, outward, bounce)
        c = project_to_film(self.sensor, followed.visible)
        size = mi.Point2f(self.sensor.film().crop_size())
        ok = valid & followed.valid & dr.all((c > -self.border) & (c < size + self.border))
        followed.valid = ok & ((self.curves.to_camera @ followed.visible).z > self.sensor.near_clip())
        scattered, radiance, ok = self._reflected(drawn, cast, followed, bounce)
        lit, _ = self.curves.rays(drawn, cast, followed, outward)
        radiance = dr.select(ok & self._reaches(drawn, lit, followed.lit), radiance, 0)
        if indirect:
            radiance = channel_mean(mi.unpolarized_spectrum(radiance))
            typical = mean(radiance)
            radiance = mi.Spectrum(radiance + dr.select(typical > 0, _INDIRECT * typical, 1))
        _, area, _ = self.curves.film_vectors(followed)
        value = channel_mean(mi.unpolarized_spectrum(scattered * radiance))
        importance = dr.select(ok, drawn.weight * area * value, 0)
        dr.eval(cast, outward, importance, drawn.weight)
        return cast, outward, importance

    def _reflected(
        self, drawn: ShadowSamples, cast: mi.Bool, followed: ShadowPoints, bounce: int
    ) -> tuple[mi.Spectrum, mi.Spectrum, mi.Bool]:
        """What the camera sees per light at the boundary; the emitter's light; whether it is seen at all."""
        film = self.sensor.film()
        visible, tolerance = dr.detach(followed.visible), 1e-3
        if not bounce:  # on the face that the light reaches
            visible = dr.select(cast, visible, visible + 1e-3 * dr.norm(followed.along) * followed.across)
        u = project_to_film(self.sensor, visible) / mi.Vector2f(film.crop_size())
        ray, throughput = self.sensor.sample_ray(self.sensor.shutter_open(), 0.0, u, mi.Point2f(0.5))
        si = self.integrator.first_hit(self.scene, ray, followed.valid).compute_surface_interaction(
            ray, mi.RayFlags.All, followed.valid
        )
        ok = followed.valid & si.is_valid() & (dr.norm(si.p - visible) < tolerance * si.t)
        context = mi.BSDFContext()
        if bounce:
            throughput = throughput * si.bsdf().eval(context, si, si.to_local(followed.via), ok)
            target = dr.select(
                cast, followed.lit, followed.lit + 1e-2 * dr.norm(followed.along) * followed.across
            )
            d = dr.normalize(target - si.p)
            si = self.scene.ray_intersect(si.spawn_ray(d), ok)
            ok &= si.is_valid() & (dr.norm(si.p - target) < tolerance * si.t)
            throughput *= 4 * dr.pi
        direction, radiance = self._light(drawn, si, ok)
        scattered = throughput * si.bsdf().eval(context, si, si.to_local(direction), ok)
        return scattered, radiance, ok

    def _light(
        self, drawn: ShadowSamples, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Spectrum]:
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

    def _reaches(self, drawn: ShadowSamples, ray: mi.Ray3f, lit: mi.Point3f) -> mi.Bool:
        """Whether rays meet nothing on their way to the light."""
        ray = mi.Ray3f(ray)
        if drawn.is_point:
            ray.maxt = dr.norm(mi.Point3f(drawn.position) - ray.o) * (1 - 1e-3)
        return ~self.scene.ray_test(ray)
