"""Path replay of the vertices after the second."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from .path_vertex import material_point, sample_direct, scattering, segment
from .supported_scenes import has_bsdf_flag, has_surface_emitters

if TYPE_CHECKING:
    from .gshell_path import GShellPathIntegrator


@dr.syntax
def replay(
    integrator: GShellPathIntegrator,
    mode: dr.ADMode,
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    pi: mi.PreliminaryIntersection3f,
    si_prev: mi.SurfaceInteraction3f,
    L: mi.Spectrum,
    beta: mi.Spectrum,
    eta: mi.Float,
    pdf_prev: mi.Float,
    delta_prev: mi.Bool,
    active: mi.Bool,
    depth: mi.UInt32,
    scattered: mi.Bool,
    adjoint: mi.Spectrum,
    p_tangent: mi.Vector3f,
) -> mi.Vector3f | mi.Spectrum:
    """Path replay (Vicini et al. 2021) of the remaining vertices.

    Reverse mode takes the adjoint of the radiance and returns that of the position of the vertex
    before; forward mode takes the tangent of that position and returns the radiance's.
    """
    surface_emitters = has_surface_emitters(scene)
    special = has_bsdf_flag(scene, mi.BSDFFlags.Delta)
    backward = mode == dr.ADMode.Backward
    depth, start = mi.UInt32(depth), mi.UInt32(depth)
    tangent = mi.Spectrum(0)
    on_first = mi.Vector3f(0)
    first_p = mi.Point3f(si_prev.p)
    pi_prev, ray_prev = dr.zeros(mi.PreliminaryIntersection3f, dr.width(pi)), mi.Ray3f(ray)
    active, scattered = mi.Bool(active), mi.Bool(scattered)

    while dr.hint(active, max_iterations=integrator.gradient_depth - 2, label="gshell_path (replay)"):
        second = depth == start
        with dr.resume_grad():
            p_first = mi.Point3f(first_p)
            dr.enable_grad(p_first)
            if dr.hint(not backward, mode="scalar"):
                dr.set_grad(p_first, p_tangent)
            p_prev = pi_prev.compute_surface_interaction(
                ray_prev, mi.RayFlags.Minimal | mi.RayFlags.FollowShape, active & ~second
            ).p
            p_prev = dr.select(second, p_first, p_prev)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
            wi = si.to_local(dr.normalize(p_prev - si.p))
            si.wi = dr.replace_grad(si.wi, dr.select(si.is_valid(), wi, si.wi))
            emitted = beta * integrator.emission(scene, si, si_prev, pdf_prev, delta_prev, scattered, active)
        si_now = dr.detach(si)
        bsdf = si_now.bsdf(mi.RayDifferential3f(ray))
        active_next = active & (depth + 1 < integrator.gradient_depth) & si_now.is_valid()
        with dr.resume_grad():
            direct = beta * sample_direct(
                scene, si, bsdf, sampler.next_2d(), active_next, True, surface_emitters
            )
        sample, weight = bsdf.sample(
            mi.BSDFContext(), si_now, sampler.next_1d(), sampler.next_2d(), active_next
        )
        L -= dr.detach(emitted) + dr.detach(direct)
        ray_next = si_now.spawn_ray(si_now.to_world(sample.wo))
        beta *= weight
        eta *= sample.eta
        beta, active_next = integrator.roulette(beta, eta, depth, sampler, active_next)
        pi_next = scene.ray_intersect_preliminary(ray_next, coherent=False, active=active_next)
        with dr.resume_grad():
            p_next, area_next = material_point(pi_next, ray_next, active_next)
            d, solid_angle = segment(si.p, p_next, area_next, active_next & pi_next.is_valid(), ray_next.d)
            change = scattering(bsdf, si, d, solid_angle, sample, active_next, special)
            indirect = dr.select(active_next, L * change, 0)
            radiance = emitted + direct + indirect
            if dr.hint(backward, mode="scalar"):
                dr.backward_from(adjoint * radiance)
                on_first += dr.select(active & second, mi.Vector3f(dr.grad(p_first)), 0)
            else:
                tangent += dr.forward_to(radiance)
        si_prev = si_now
        scattered |= active & ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        pdf_prev, delta_prev = sample.pdf, mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        depth[si_now.is_valid()] += 1
        pi_prev, pi = pi, pi_next
        ray_prev, ray = ray, ray_next
        active = active_next

    return on_first if backward else tangent
