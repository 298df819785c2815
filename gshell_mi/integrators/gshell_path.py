"""The reparameterised path integrator ``gshell_path``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from ..arrays import AnyArray
from ..errors import UserError
from ..timing import phase
from . import primal_film, reparameterised_film, shadow_boundary
from .edge_table import EdgeTable
from .film_integrator import OnSample
from .path_replay import replay
from .path_sample import PathSample
from .path_vertex import delta_lobe, material_point, mis_weight, sample_direct, scattering, segment
from .shadow_boundary import BoundaryTerm
from .supported_scenes import check_meshes, has_bsdf_flag, has_surface_emitters


class GShellPathIntegrator(ADIntegrator):
    """Path integrator whose derivatives include those of visibility.

    Primary visibility moves by a warp of the film that follows the silhouettes
    (``warp``); what the first surface receives, by the shadow boundaries on
    the film (``shadow_boundary``). Derivatives reach vertex positions, mesh
    attributes, BSDFs, emitters and the sensor's ``to_world`` in one pass; alpha is differentiable.
    Films keep any reconstruction filter, crop window and ``sample_border``. Sensors: ``perspective``;
    another one raises ``UserError`` when differentiated.

    Plugin parameters:

    * ``max_depth`` (int, default 6), ``rr_depth`` (int, default 5), ``hide_emitters`` (bool, default
      false): as for ``prb``.
    * ``gradient_depth`` (int, default ``max_depth``): derivatives are those of the image with this
      ``max_depth``. What longer paths add to the image counts as constant, which spares time.
    * ``reparam_depth`` (int, default 3): how many segments of a path may lose sight of what they see:
      1 the camera's, 2 also what the first surface receives, 3 also what the second one does. Below
      ``gradient_depth``, derivatives lack those of moving shadows, for less time
      (``docs/gradients.md``).
    * ``warp_radius`` (float, default 2 pixels): how far the warp reaches around a silhouette.
    * ``light_edge_samples`` (float, default 1): samples of shadow boundaries per pixel of the film.
    * ``crease_angle`` (float, default 0.1 degrees): edges of flat-shaded meshes above it count as
      silhouettes do.
    * ``cull_hidden`` (bool, default true): leave out silhouettes that other surfaces hide.

    ```xml
    <integrator type="gshell_path"> <integer name="max_depth" value="3"/> </integrator>
    ```

    ```python
    integrator = mi.load_dict({'type': 'gshell_path', 'max_depth': 3})
    ```
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.hide_emitters = props.get("hide_emitters", False)
        self.warp_radius = props.get("warp_radius", 2.0)
        self.cull_hidden = props.get("cull_hidden", True)
        gradient_depth = props.get("gradient_depth", max(self.max_depth, 1))
        if gradient_depth < 1:
            raise UserError(f"gshell_path: gradient_depth is {gradient_depth}, but has to be at least 1.")
        self.gradient_depth: int = min(gradient_depth, self.max_depth)
        self.reparam_depth = props.get("reparam_depth", 3)
        if self.reparam_depth not in (1, 2, 3):
            raise UserError(f"gshell_path: reparam_depth is {self.reparam_depth}, but has to be 1, 2 or 3.")
        self.said = set()  # warnings given so far
        self.crease_angle = props.get("crease_angle", 0.1)
        self.light_edge_samples = props.get("light_edge_samples", 1.0)

    # ------------------------------------------------------------------ rendering

    def sample(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        active: mi.Bool | bool = True,
        **kwargs: Any,
    ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float], None]:
        check_meshes(scene)
        result = self.primal(scene, sampler, mi.Ray3f(ray), active, max_depth=self.max_depth)
        return result.value, result.alpha > 0.5, result.aovs, None

    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        if not develop:
            return super().render(scene, sensor, seed, spp, develop, evaluate)
        return primal_film.render(self, scene, sensor, seed, spp)

    def render_forward(
        self, scene: mi.Scene, params: Any, sensor: int | mi.Sensor = 0, seed: int = 0, spp: int = 0
    ) -> mi.TensorXf:
        return reparameterised_film.render_forward(self, scene, sensor, seed, spp)

    def render_backward(
        self,
        scene: mi.Scene,
        params: Any,
        grad_in: mi.TensorXf,
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        spp: int = 0,
    ) -> None:
        with phase("render backward"):
            reparameterised_film.render_backward(self, scene, grad_in, sensor, seed, spp)

    # ------------------------------------------------------------------ paths

    def first_hit(
        self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool | bool = True
    ) -> mi.PreliminaryIntersection3f:
        """The first intersection, behind the area lights if emitters are hidden."""
        pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        if self.hide_emitters and has_surface_emitters(scene):
            skip = pi.is_valid() & (pi.shape.emitter() != None) & active  # noqa: E711
            si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, skip)
            pi[skip] = self.skip_area_emitters(scene, si.spawn_ray(ray.d), True, skip)
        return pi

    @dr.syntax
    def primal(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        active: mi.Bool | bool = True,
        start: int = 0,
        max_depth: int | None = None,
    ) -> PathSample:
        """Radiance and coverage along camera rays, without derivatives; by default, what is differentiated.

        With ``start`` = 1 the rays are those of a second segment instead: the light that arrives
        along them other than from area lights.
        """
        max_depth = self.gradient_depth if max_depth is None else max_depth
        ray = mi.Ray3f(dr.detach(ray))
        depth = mi.UInt32(start)
        L, beta, eta = mi.Spectrum(0), mi.Spectrum(1), mi.Float(1)
        active = mi.Bool(active)
        scattered = mi.Bool(start > 0)  # past the surfaces that camera rays just pass through
        transparent = has_bsdf_flag(scene, mi.BSDFFlags.Null)
        if dr.hint(start == 0, mode="scalar"):
            pi = self.first_hit(scene, ray, active)
        else:
            pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        si_prev = dr.zeros(mi.SurfaceInteraction3f)
        pdf_prev, delta_prev = mi.Float(1), mi.Bool(True)

        while dr.hint(active, max_iterations=max_depth - start, label="gshell_path (primal)"):
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
            bsdf = si.bsdf(ray)
            shines = active
            if dr.hint(start > 0, mode="scalar"):
                shines = active & ~((depth == start) & si.is_valid())
            L += beta * self.emission(scene, si, si_prev, pdf_prev, delta_prev, scattered, shines)
            active_next = active & (depth + 1 < max_depth) & si.is_valid()
            L += beta * sample_direct(scene, si, bsdf, sampler.next_2d(), active_next, False, False)
            # Whether the last surface of a path covers the film is sampled too.
            sampled = active & si.is_valid() if transparent else active_next
            sample, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), sampled)
            scattered |= active & si.is_valid() & ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
            ray = si.spawn_ray(si.to_world(sample.wo))
            beta *= weight
            eta *= sample.eta
            si_prev = si
            pdf_prev, delta_prev = sample.pdf, mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
            beta, active_next = self.roulette(beta, eta, depth, sampler, active_next)
            pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active_next)
            depth[si.is_valid()] += 1
            active = active_next

        covered = scattered | (not self.hide_emitters and scene.environment() is not None)
        # A sliver's attributes may interpolate to no number; that would reach all pixels around the sample.
        L = dr.select(dr.all(dr.isfinite(L)), L, 0)
        return PathSample(L, dr.select(covered, mi.Float(1), mi.Float(0)), [])

    def emission(
        self,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        si_prev: mi.SurfaceInteraction3f,
        pdf_prev: mi.Float,
        delta_prev: mi.Bool,
        scattered: mi.Bool,
        active: mi.Bool,
    ) -> mi.Spectrum:
        """Light emitted at a vertex towards the one before, weighted against emitter sampling."""
        if self.hide_emitters:
            active = active & (scattered | si.is_valid())
        ds = mi.DirectionSample3f(scene, si=dr.detach(si), ref=si_prev)
        emitter_pdf = scene.pdf_emitter_direction(si_prev, ds, ~delta_prev)
        return mis_weight(pdf_prev, emitter_pdf) * ds.emitter.eval(si, active)

    def roulette(
        self, beta: mi.Spectrum, eta: mi.Float, depth: mi.UInt32, sampler: mi.Sampler, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Bool]:
        peak = dr.max(mi.unpolarized_spectrum(beta))
        survive = dr.minimum(peak * dr.square(eta), 0.95)
        play = depth >= self.rr_depth
        go_on = sampler.next_1d() < survive
        beta = dr.select(play, beta * dr.rcp(survive), beta)
        return beta, active & (peak != 0) & (~play | go_on)

    # ------------------------------------------------------------------ shadows

    def boundary_terms(
        self, scene: mi.Scene, tables: list[tuple[mi.Mesh, EdgeTable]], sensor: mi.Sensor, seed: int
    ) -> Iterable[BoundaryTerm]:
        """Yields the ``BoundaryTerm`` of shadows."""
        return shadow_boundary.boundary_terms(self, scene, tables, sensor, seed)

    def replays(self, scene: mi.Scene) -> bool:
        """Whether ``attached`` needs to know the radiance and coverage of its samples beforehand."""
        return self.gradient_depth > 3 or has_bsdf_flag(scene, mi.BSDFFlags.Delta)

    def attached(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        state: PathSample | None,
        on_sample: OnSample,
        film_terms: Sequence[AnyArray] = (),
    ) -> tuple[Any, Any]:
        """Derivatives of camera paths.

        ``ray`` is attached to the film warp and the sensor; ``state`` is what ``primal`` returned for
        it, which is needed only if the integrator replays paths. In reverse mode returns a ``Float``
        whose derivative is that of the adjoint-weighted samples, and the samples; in forward mode the
        channels' tangents and those of ``film_terms``.
        """
        radiance, alpha, last, tail = self._first_vertices(scene, sampler, ray, state)
        if state is None:
            state = PathSample(dr.detach(radiance), dr.detach(alpha), [])
        if mode == dr.ADMode.Backward:
            total = on_sample(radiance, alpha, state.aovs)
            if tail is not None:
                with dr.suspend_grad():
                    on_last = replay(
                        self,
                        mode,
                        *tail,
                        adjoint=_adjoint_of_value(on_sample, state),
                        p_tangent=mi.Vector3f(0),
                    )
                total += dr.dot(last, on_last)
            return total, state
        # Interior gradients are results too, and the replay needs those of the inputs again.
        dr.forward_to(radiance, alpha, last, *film_terms, flags=dr.ADFlag.ClearEdges)
        tangent, alpha_tangent = dr.grad(radiance), mi.Float(dr.grad(alpha))
        film_tangents = [dr.grad(x) for x in film_terms]
        if tail is not None:
            with dr.suspend_grad():
                tangent += replay(
                    self, mode, *tail, adjoint=mi.Spectrum(0), p_tangent=mi.Vector3f(dr.grad(last))
                )
        return on_sample(tangent, alpha_tangent, []), film_tangents

    def _first_vertices(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, state: PathSample | None
    ) -> tuple[mi.Spectrum, mi.Float, mi.Point3f, tuple[Any, ...] | None]:
        """The first two vertices of each path, whose motions depend on each other, attached.

        Returns radiance, coverage, the position of the second vertex and what the replay of the
        remaining vertices takes, or ``None`` if the paths end here. Nothing else that is attached may
        outlive this function: forward mode stumbles over dangling variables.
        """
        surface_emitters = has_surface_emitters(scene)
        special = has_bsdf_flag(scene, mi.BSDFFlags.Delta)
        context = mi.BSDFContext()
        deeper = self.gradient_depth > 3
        depth = mi.UInt32(0)
        with dr.suspend_grad():
            pi = self.first_hit(scene, dr.detach(ray))
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
        bsdf = si.bsdf(mi.RayDifferential3f(dr.detach(ray)))
        active = mi.Bool(True)
        no_vertex = dr.zeros(mi.SurfaceInteraction3f)
        radiance = self.emission(scene, si, no_vertex, mi.Float(1), mi.Bool(True), mi.Bool(False), active)
        scattered = mi.Bool(False)
        throughput = mi.Spectrum(1)  # of value 1, carries the derivatives of the vertices so far
        beta, eta = mi.Spectrum(1), mi.Float(1)
        always = not self.hide_emitters and scene.environment() is not None
        if state is None:
            alpha = dr.select(dr.detach(si.is_valid()) | always, mi.Float(1), mi.Float(0))
        else:
            alpha = state.alpha

        for vertex in range(min(self.gradient_depth - 1, 2)):
            active &= (depth + 1 < self.gradient_depth) & si.is_valid()
            si_now = dr.detach(si)
            radiance += (
                throughput
                * beta
                * sample_direct(scene, si, bsdf, sampler.next_2d(), active, True, surface_emitters)
            )
            choice, sample2 = sampler.next_1d(), sampler.next_2d()
            with dr.suspend_grad():
                sample, weight = bsdf.sample(context, si_now, choice, sample2, active)
                ray_next = si_now.spawn_ray(si_now.to_world(sample.wo))
                delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
                scattered |= ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
                eta *= sample.eta
                beta, active = self.roulette(beta * weight, eta, depth, sampler, active)
                pi = scene.ray_intersect_preliminary(ray_next, coherent=False, active=active)
            depth = depth + 1
            to_point = mi.Spectrum(0)  # replaced wherever it counts
            if surface_emitters or vertex == 1:
                p_next, area_next = material_point(pi, ray_next, active)
                d, solid_angle = segment(si.p, p_next, area_next, active & pi.is_valid(), ray_next.d)
                to_point = throughput * scattering(bsdf, si, d, solid_angle, sample, active, special)
            if vertex == 1:
                if not deeper:  # else the replay counts what the last vertex emits
                    last = pi.compute_surface_interaction(
                        ray_next, mi.RayFlags.All | mi.RayFlags.FollowShape, active
                    )
                    radiance += (
                        to_point
                        * beta
                        * self.emission(scene, last, si_now, sample.pdf, delta, scattered, active)
                    )
                break
            # Light of emitters arrives from a point of theirs, all other along a fixed direction: in
            # these forms the integrand moves least, and emitter sampling uses the same.
            along = mi.Ray3f(ray_next)
            along.o = dr.replace_grad(ray_next.o, si.p)
            change = dr.relative_grad(bsdf.eval(context, si, si.to_local(ray_next.d), active))
            if special:
                d, change, seen = delta_lobe(
                    bsdf, si, ray, ray_next, choice, sample2, delta, active, sample.sampled_type, change
                )
                alpha *= 1 if always else seen
                along.d = dr.replace_grad(ray_next.d, d)
            throughput = throughput * change
            si_next = pi.compute_surface_interaction(along, mi.RayFlags.All, active)
            emitted = beta * self.emission(scene, si_next, si_now, sample.pdf, delta, scattered, active)
            if surface_emitters:
                emitted *= dr.select(pi.is_valid() & ~delta, to_point, throughput)
            else:
                emitted *= throughput
            radiance += emitted
            si, bsdf = si_next, si_next.bsdf(mi.RayDifferential3f(dr.detach(ray_next)))

        if not deeper:
            return radiance, alpha, mi.Point3f(0), None
        assert state is not None, "replays(scene) has asked for it"
        rest = state.value - dr.detach(radiance)
        radiance += dr.select(active, to_point * rest, 0)
        return (
            radiance,
            alpha,
            si.p,
            (
                scene,
                sampler,
                ray_next,
                pi,
                si_now,
                rest,
                beta,
                eta,
                sample.pdf,
                delta,
                active,
                depth,
                scattered,
            ),
        )

    def to_string(self) -> str:
        return (
            f"GShellPathIntegrator[max_depth={self.max_depth}, rr_depth={self.rr_depth}, "
            f"gradient_depth={self.gradient_depth}, hide_emitters={self.hide_emitters}, "
            f"reparam_depth={self.reparam_depth}, warp_radius={self.warp_radius}]"
        )


def _adjoint_of_value(on_sample: OnSample, state: PathSample) -> mi.Spectrum:
    """Adjoint of the radiance of each sample (``on_sample`` is linear in it)."""
    with dr.resume_grad():
        value = mi.Spectrum(state.value)
        dr.enable_grad(value)
        dr.backward_from(on_sample(value, dr.detach(state.alpha), dr.detach(state.aovs)))
        return dr.grad(value)


mi.register_integrator("gshell_path", lambda props: GShellPathIntegrator(props))
