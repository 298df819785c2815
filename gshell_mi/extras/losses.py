"""Losses that a fit leaves out: on most scenes none is worth more than noise (docs/losses.md)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .. import losses
from ..extraction.surface_mesh import SurfaceMesh, gather
from ..fit.joint.regularisers import StepView, register_loss


@register_loss("hole_opening")
def hole_opening(step: StepView) -> mi.Float:
    """Pulls the mSDF of the surface below 0, so that openings appear and can be judged."""
    surface = step.subject.surface
    kept = dr.arange(mi.UInt32, surface.kept_vertex_count)
    return losses.hole_opening(gather(mi.Float, _msdf_of(step, surface), kept))


@register_loss("hole_closing", per_view=True)
def hole_closing(step: StepView) -> mi.Float:
    """Pulls the mSDF of visible boundaries above 0, so that holes shut."""
    surface = step.subject.surface
    count = surface.vertex_count - surface.kept_vertex_count
    if count == 0:
        return mi.Float(0)
    rim = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, surface.kept_vertex_count)
    msdf = gather(mi.Float, _msdf_of(step, surface), rim)
    with dr.suspend_grad():
        visible = step.is_visible(gather(mi.Point3f, mi.Point3f(surface.vertices), rim))
    return losses.hole_closing(msdf, visible)


@register_loss("visible_outside", per_view=True)
def visible_outside(step: StepView) -> mi.Float:
    """Punishes mSDF that is seen outside the masks."""
    return losses.visible_outside(_template_msdf(step), step.alpha)


@register_loss("visible_inside", per_view=True)
def visible_inside(step: StepView) -> mi.Float:
    """Punishes negative mSDF where a mask is covered and no surface is."""
    _, hit = step.first_hits
    return losses.visible_inside(_template_msdf(step), step.alpha, hit.is_valid())


@register_loss("sdf_sign")
def sdf_sign(step: StepView) -> mi.Float:
    """Cross-entropy between the signs of neighbouring lattice vertices: removes floaters."""
    return losses.sign_cross_entropy(step.in_cells("sdf"), step.subject.lattice)


@register_loss("eikonal")
def eikonal(step: StepView) -> mi.Float:
    """Squared difference between the slope of the signed distance and 1, near the surface."""
    return losses.eikonal(step.in_cells("sdf"), step.subject.lattice)


@register_loss("normal_variation")
def normal_variation(step: StepView) -> mi.Float:
    """Differences of the surface's normals along edges: bumps that no image asks for go."""
    surface = step.subject.surface
    return losses.normal_variation(mi.Vector3f(surface.vertex_normals()), mi.Vector3u(surface.faces))


@register_loss("albedo_chroma", per_view=True, needs="material")
def albedo_chroma(step: StepView) -> mi.Float:
    """Difference between the chroma of the base colour and of the image that shows it."""
    ray, hit = step.first_hits
    interaction = hit.compute_surface_interaction(ray, mi.RayFlags.All)
    on_subject = step.on_subject(hit)
    albedo = mi.Color3f(interaction.shape.eval_attribute_3("vertex_color", interaction, on_subject))
    return losses.chroma_difference(albedo, step.color, on_subject & (step.alpha > 0.5))


@register_loss("light_smoothness", needs="light")
def light_smoothness(step: StepView) -> mi.Float:
    """Difference between neighbouring texels of the light's logarithm."""
    assert step.light is not None, "the loss needs it"
    return losses.light_smoothness(step.light.log_radiance)


def _msdf_of(step: StepView, mesh: SurfaceMesh) -> mi.Float:
    """ν at a mesh's vertices in cells, attached to the field but not to where the vertices are."""
    if mesh.is_empty:
        return mi.Float([])
    msdf = step.in_cells("msdf")
    assert mesh.stencil is not None, "it is extracted"
    return dr.detach(mesh.stencil).apply(lambda vertex: gather(mi.Float, msdf, vertex))


def _template_msdf(step: StepView) -> mi.Float:
    """ν in cells where the view's rays meet the template first, attached to the field; 0 elsewhere."""
    ray, first = step.first_hits
    with dr.suspend_grad():
        # On a GPU, a kernel traces rays in one scene only.
        dr.eval(ray, first)
        mesh = mi.Mesh("template", step.template.vertex_count, step.template.face_count)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = dr.ravel(dr.detach(step.template.vertices))
        parameters["faces"] = dr.ravel(step.template.faces)
        parameters.update()
        hit = mi.load_dict({"type": "scene", "template": mesh}).ray_intersect_preliminary(ray)
        dr.eval(hit)
    valid = hit.is_valid()
    face = dr.gather(mi.Vector3u, dr.ravel(step.template.faces), hit.prim_index, valid)
    uv = dr.select(valid, hit.prim_uv, 0)
    msdf = _msdf_of(step, step.template)
    corners = [dr.gather(mi.Float, msdf, face[i], valid, mode=dr.ReduceMode.Local) for i in range(3)]
    return (1 - uv.x - uv.y) * corners[0] + uv.x * corners[1] + uv.y * corners[2]
