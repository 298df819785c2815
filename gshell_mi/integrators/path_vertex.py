"""The terms of one path vertex: sampled without derivatives, evaluated with them.

Paths are written as integrals over surfaces. Every vertex after the first is a material point: it
keeps its place on its triangle while the triangle moves. Its contribution then depends on its two
neighbours only, which is what makes path replay possible when geometry moves (Zhang et al. 2020,
"Path-space differentiable rendering"; Worchel et al. 2025, "Radiative backpropagation with
non-static geometry"). The Jacobian of a sampled direction is the geometry term times the stretch
of the triangle, both relative to their present values.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..means import channel_mean


def mis_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Power heuristic, without derivatives."""
    a2, b2 = dr.square(dr.detach(pdf_a)), dr.square(dr.detach(pdf_b))
    return dr.select(a2 > 0, a2 / (a2 + b2), 0)


def material_point(
    pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.Point3f, mi.Vector3f]:
    """The hit as a point of its surface: position and ``n dA``, attached to the shape.

    ``n dA`` is the surface normal times the local stretch of area relative to now; only its
    derivative and its direction have a meaning.
    """
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal | mi.RayFlags.FollowShape, active)
    mesh = mi.MeshPtr(pi.shape)
    index = mesh.face_indices(pi.prim_index, active)
    p0, p1, p2 = (mesh.vertex_position(index[k], active) for k in range(3))
    area = dr.norm(dr.cross(p1 - p0, p2 - p0))
    return si.p, si.n * dr.relative_grad(area)


def segment(
    p: mi.Point3f, p_next: mi.Point3f, area_next: mi.Vector3f, valid: mi.Bool, d: mi.Vector3f
) -> tuple[mi.Vector3f, mi.Float]:
    """Direction to a material point, and the derivative of its solid angle as a factor of value 1.

    ``d``: the direction's present value, kept where ``valid`` is false (the ray left the scene).
    """
    offset = p_next - p
    distance2 = dr.squared_norm(offset)
    direction = offset * dr.rsqrt(distance2)
    solid_angle = dr.abs_dot(direction, area_next) / distance2
    solid_angle = dr.select(valid & (distance2 > 0), solid_angle, 1)
    return (dr.replace_grad(d, dr.select(valid, direction, d)), dr.relative_grad(solid_angle))


def sample_direct(
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDF,
    sample: mi.Point2f,
    active: mi.Bool,
    attached: bool,
    surface_emitters: bool,
) -> mi.Spectrum:
    """Light that one emitter sample sends through the vertex, weighted against BSDF sampling.

    Args:
        attached: whether to track derivatives (a Python ``bool``).
        surface_emitters: whether the scene has any area light (a Python ``bool``).
    """
    context = mi.BSDFContext()
    active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    ds, weight = scene.sample_emitter_direction(dr.detach(si), sample, True, active)
    active &= ds.pdf != 0
    pdf = ds.pdf
    if attached:
        infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        p, solid_angle = ds.p, mi.Float(1)
        if surface_emitters:
            on_surface = active & mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
            ray = dr.detach(si).spawn_ray_to(ds.p)
            ray.maxt = dr.largest(mi.Float)
            pi = scene.ray_intersect_preliminary(ray, active=on_surface)
            on_surface &= pi.is_valid()
            p_em, area_em = material_point(pi, ray, on_surface)
            p = dr.replace_grad(p, dr.select(on_surface, p_em, p))
            _, solid_angle = segment(si.p, p, area_em, on_surface, ds.d)
        offset = p - si.p
        distance = dr.norm(offset)
        ds.d = dr.replace_grad(ds.d, dr.select(infinite, ds.d, offset / distance))
        ds.dist = dr.replace_grad(ds.dist, dr.select(infinite, ds.dist, distance))
        value = scene.eval_emitter_direction(si, ds, active)
        weight = dr.replace_grad(weight, value * dr.select(pdf != 0, dr.rcp(pdf), 0))
        weight *= solid_angle
    value, bsdf_pdf = bsdf.eval_pdf(context, si, si.to_local(ds.d), active)
    return dr.select(active, dr.select(ds.delta, 1, mis_weight(pdf, bsdf_pdf)) * value * weight, 0)


def scattering(
    bsdf: mi.BSDF,
    si: mi.SurfaceInteraction3f,
    d: mi.Vector3f,
    solid_angle: mi.Float,
    sample: mi.BSDFSample3f,
    active: mi.Bool,
    special: bool,
) -> mi.Spectrum:
    """Factor of value 1 with the derivative of scattering towards a point.

    Where light just passes through (``mask``), of the transmission; the geometry of such a
    segment is that of the surfaces at its ends and is left out.
    """
    change = dr.relative_grad(bsdf.eval(mi.BSDFContext(), si, si.to_local(d), active)) * solid_angle
    if not special:
        return change
    passes = active & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    return dr.select(passes, dr.relative_grad(bsdf.eval_null_transmission(si, active)), change)


def delta_lobe(
    bsdf: mi.BSDF,
    si: mi.SurfaceInteraction3f,
    ray: mi.Ray3f,
    ray_next: mi.Ray3f,
    choice: mi.Float,
    sample2: mi.Point2f,
    delta: mi.Bool,
    active: mi.Bool,
    kind: mi.UInt32,
    change: mi.Spectrum,
) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
    """Direction, and relative weight and coverage, where the first surface scatters in one direction.

    A mirrored or refracted direction follows the surface, and one that passes through (``mask``)
    the camera ray; the chance to pass is the opacity's complement.
    """
    context = mi.BSDFContext()
    passes = active & mi.has_flag(kind, mi.BSDFFlags.Null)
    sample, weight = bsdf.sample(context, si, choice, sample2, active)
    transmission = bsdf.eval_null_transmission(si, active)
    d = dr.select(passes, ray.d, dr.select(delta, si.to_world(sample.wo), ray_next.d))
    change = dr.select(
        passes, dr.relative_grad(transmission), dr.select(delta, dr.relative_grad(weight), change)
    )
    opacity = 1 - channel_mean(mi.unpolarized_spectrum(transmission))
    seen = dr.select(passes, dr.relative_grad(1 - opacity), dr.relative_grad(opacity))
    return d, change, dr.select(active, seen, 1)
