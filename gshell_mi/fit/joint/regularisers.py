"""The terms of the joint stage's loss beside image and mask; one of weight 0 is never computed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import losses
from ...extraction.flexicubes import deviation
from ...extraction.surface_mesh import SurfaceMesh, gather
from ...light import EnvironmentLight
from ...material import MaterialField
from ...means import mean
from ...scene import FitScene
from ...views import PinholeViews
from ..config import FitConfig

#: Coverage from which on a pixel shows one surface.
_WHOLE = 0.99

#: Depths that differ by more cells than this are those of different surfaces.
_DEPTH_LIMIT = 4.0

#: A boundary vertex is seen if nothing is nearer to the camera than this fraction of its distance.
_UNTIL = 0.999


class Regularisers:
    """Losses of the subject's fields, the material and the light.

    Each term has the name of its weight in ``FitConfig``.

    Args:
        fit: its subject holds the attached fields and mesh of the present step.
        scene: the scene that is rendered.
        material, light: what is optimised; None for what is given.
        config: the weights.
    """

    def __init__(self, fit: FitScene, scene: mi.Scene, material: MaterialField | None,
                 light: EnvironmentLight | None, config: FitConfig):
        self._fit, self._scene, self._material, self._light = fit, scene, material, light
        self._subject = fit.subject
        terms: dict[str, Callable[[], mi.Float]] = {
            "hole_opening": self._hole_opening,
            "hole_closing": self._over_views(self._hole_closing),
            "visible_outside": self._over_views(self._visible_outside),
            "visible_inside": self._over_views(self._visible_inside),
            "sdf_sign": lambda: losses.sign_cross_entropy(self._in_cells("sdf"), self._subject.lattice),
            "eikonal": lambda: losses.eikonal(self._in_cells("sdf"), self._subject.lattice),
            "template_smoothness": self._template_smoothness,
        }
        if any(target.depth is not None for target in fit.targets):
            terms["joint_depth"] = self._over_views(self._depth)
        if self._subject.lattice.weight_count:
            terms["flexicubes_deviation"] = self._flexicubes_deviation
        if material:
            terms |= {"material_smoothness": self._material_smoothness,
                      "albedo_chroma": self._over_views(self._albedo_chroma)}
        if light:
            terms |= {"light_smoothness": lambda: losses.light_smoothness(light.log_radiance),
                      "light_grey": self._light_grey}
        self._terms = {name: (getattr(config, name), term) for name, term in terms.items()
                       if getattr(config, name) > 0}
        self._view, self._step_views = 0, ()

    def __call__(self, views: Sequence[int]) -> tuple[mi.Float, dict[str, mi.Float]]:
        """The weighted sum, and every loss of its own, for a step on the views with these indices."""
        self._step_views = views
        self.__dict__.pop("_template", None)
        total, values = mi.Float(0), {}
        for name, (weight, term) in self._terms.items():
            values[name] = term()
            total += weight * values[name]
        return total, values

    def _over_views(self, term: Callable[[], mi.Float]) -> Callable[[], mi.Float]:
        """The mean of a term over the views of the step."""
        def averaged() -> mi.Float:
            total = mi.Float(0)
            for view in self._step_views:
                self._view = view
                self.__dict__.pop("_first_hits", None)
                total += term()
            return total / len(self._step_views)
        return averaged

    # --- the mSDF

    def _hole_opening(self) -> mi.Float:
        kept = dr.arange(mi.UInt32, self._subject.surface.kept_vertex_count)
        return losses.hole_opening(gather(mi.Float, self._msdf_of(self._subject.surface), kept))

    def _hole_closing(self) -> mi.Float:
        surface = self._subject.surface
        count = surface.vertex_count - surface.kept_vertex_count
        if count == 0:
            return mi.Float(0)
        rim = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, surface.kept_vertex_count)
        msdf = gather(mi.Float, self._msdf_of(surface), rim)
        with dr.suspend_grad():
            visible = self._is_visible(gather(mi.Point3f, mi.Point3f(surface.vertices), rim))
        return losses.hole_closing(msdf, visible)

    def _visible_outside(self) -> mi.Float:
        return losses.visible_outside(self._template_msdf(), self._alpha)

    def _visible_inside(self) -> mi.Float:
        _, hit = self._first_hits
        return losses.visible_inside(self._template_msdf(), self._alpha, hit.is_valid())

    def _msdf_of(self, mesh: SurfaceMesh) -> mi.Float:
        """ν at a mesh's vertices in cells, attached to the field but not to where the vertices are."""
        if mesh.is_empty:
            return mi.Float([])
        msdf = self._in_cells("msdf")
        return dr.detach(mesh.stencil).apply(lambda vertex: gather(mi.Float, msdf, vertex))

    def _template_msdf(self) -> mi.Float:
        """ν in cells where the view's rays meet the template first, attached to the field; 0 elsewhere."""
        ray, first = self._first_hits
        with dr.suspend_grad():
            # On a GPU, a kernel traces rays in one scene only.
            dr.eval(ray, first)
            mesh = mi.Mesh("template", self._template.vertex_count, self._template.face_count)
            parameters = mi.traverse(mesh)
            parameters["vertex_positions"] = dr.ravel(dr.detach(self._template.vertices))
            parameters["faces"] = dr.ravel(self._template.faces)
            parameters.update()
            hit = mi.load_dict({"type": "scene", "template": mesh}).ray_intersect_preliminary(ray)
            dr.eval(hit)
        valid = hit.is_valid()
        face = dr.gather(mi.Vector3u, dr.ravel(self._template.faces), hit.prim_index, valid)
        uv = dr.select(valid, hit.prim_uv, 0)
        msdf = self._msdf_of(self._template)
        corners = [dr.gather(mi.Float, msdf, face[i], valid, mode=dr.ReduceMode.Local) for i in range(3)]
        return (1 - uv.x - uv.y) * corners[0] + uv.x * corners[1] + uv.y * corners[2]

    # --- the surface

    def _depth(self) -> mi.Float:
        target = self._fit.targets[self._view]
        if target.depth is None:
            return mi.Float(0)
        known = mi.Float(target.depth.ravel())
        ray, hit = self._first_hits
        interaction = hit.compute_surface_interaction(ray, mi.RayFlags.All)
        # Where a pixel is covered in part, its depth is a mixture of two surfaces.
        valid = self._on_subject(hit) & (known > 0) & (self._alpha > _WHOLE)
        # From the measured point to the tangent plane: at grazing angles a small step changes depth a lot.
        scale = dr.abs(dr.dot(dr.detach(interaction.n), ray.d)) / self._subject.cell_size
        return losses.depth_l1(dr.select(valid, interaction.t * scale, 0), known * scale, valid, _DEPTH_LIMIT)

    def _template_smoothness(self) -> mi.Float:
        normals = mi.Vector3f(self._template.vertex_normals())
        return losses.normal_variation(normals, mi.Vector3u(self._template.faces))

    def _flexicubes_deviation(self) -> mi.Float:
        spread = deviation(self._subject.surface, self._subject.lattice, self._subject.deform)
        return mean(spread) / self._subject.lattice.spacing

    # --- material and light

    def _material_smoothness(self) -> mi.Float:
        surface, total = self._subject.surface, mi.Float(0)
        for field in self._material.values().values():
            channels = dr.width(field) // self._subject.lattice.vertex_count
            values = surface.interpolate(field, channels)
            total += losses.edge_smoothness(values, mi.Vector3u(surface.faces))
        return total

    def _albedo_chroma(self) -> mi.Float:
        ray, hit = self._first_hits
        interaction = hit.compute_surface_interaction(ray, mi.RayFlags.All)
        on_subject = self._on_subject(hit)
        albedo = mi.Color3f(interaction.shape.eval_attribute_3("vertex_color", interaction, on_subject))
        return losses.chroma_difference(albedo, self._color, on_subject & (self._alpha > 0.5))

    def _light_grey(self) -> mi.Float:
        return losses.grey_world(dr.unravel(mi.Color3f, self._light.radiance.array))

    # --- what several of them need

    def _in_cells(self, name: str) -> mi.Float:
        return getattr(self._subject, name) / self._subject.lattice.spacing

    @cached_property
    def _views(self) -> PinholeViews:
        return PinholeViews.from_sensors(self._fit.sensors)

    @cached_property
    def _template(self) -> SurfaceMesh:
        """The watertight template of the present step, attached."""
        return self._subject.template()

    @cached_property
    def _first_hits(self) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
        """The rays through the pixels' centres of the present view, and what they meet first."""
        with dr.suspend_grad():
            ray = self._views.pixel_rays(self._view)
            return ray, self._scene.ray_intersect_preliminary(ray)

    def _on_subject(self, hit: mi.PreliminaryIntersection3f) -> mi.Bool:
        return hit.is_valid() & (hit.shape == mi.ShapePtr(self._subject))

    @property
    def _alpha(self) -> mi.Float:
        return mi.Float(self._fit.targets[self._view].rgba[..., 3].ravel())

    @property
    def _color(self) -> mi.Color3f:
        return mi.Color3f(np.ascontiguousarray(self._fit.targets[self._view].rgba[..., :3].reshape(-1, 3).T))

    def _is_visible(self, points: mi.Point3f) -> mi.Bool:
        """Whether the present view frames points and nothing is before them."""
        view = dr.opaque(mi.UInt32, self._view)
        film, depth = self._views.project(view, points)
        origin = self._views.origins_of(view)
        framed = (depth > 0) & (film.x >= 0) & (film.x <= 1) & (film.y >= 0) & (film.y <= 1)
        ray = mi.Ray3f(origin, points - origin, _UNTIL, 0.0, mi.Color0f())
        return framed & ~self._scene.ray_test(ray, framed)
