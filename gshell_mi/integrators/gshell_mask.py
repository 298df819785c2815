"""The silhouette and AOV integrator ``gshell_mask``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from ..arrays import AnyArray
from . import reparameterised_film
from .edge_table import EdgeTable
from .film_integrator import OnSample
from .path_sample import PathSample
from .shadow_boundary import BoundaryTerm
from .supported_scenes import check_meshes


class GShellMaskIntegrator(ADIntegrator):
    """Coverage, depth and shading normal of the first hit, with derivatives of the silhouette.

    Colour and alpha are 1 on every shape and 0 elsewhere. The AOVs are the distance to the sensor
    (scene units) and the shading normal in world space, both 0 where nothing is hit.

    Plugin parameters: ``warp_radius``, ``cull_hidden`` and ``crease_angle``, as for ``gshell_path``.

    ```xml
    <integrator type="gshell_mask"/>
    ```

    ```python
    integrator = mi.load_dict({'type': 'gshell_mask'})
    ```
    """

    #: What hits nothing is black.
    hide_emitters = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.warp_radius = props.get("warp_radius", 2.0)
        self.cull_hidden = props.get("cull_hidden", True)
        self.said = set()  # warnings given so far
        self.crease_angle = props.get("crease_angle", 0.1)

    def aov_names(self) -> list[str]:
        return ["depth", "normal.x", "normal.y", "normal.z"]

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
        result = self.primal(scene, sampler, ray, active)
        return result.value, result.alpha > 0.5, result.aovs, None

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
        reparameterised_film.render_backward(self, scene, grad_in, sensor, seed, spp)

    def primal(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool | bool = True
    ) -> PathSample:
        """The first hit along camera rays; attached to whatever ``ray`` and the scene are."""
        with dr.suspend_grad():
            pi = scene.ray_intersect_preliminary(dr.detach(mi.Ray3f(ray)), coherent=True, active=active)
        si = pi.compute_surface_interaction(mi.Ray3f(ray), mi.RayFlags.All)
        hit = si.is_valid()
        alpha = dr.select(hit, mi.Float(1), mi.Float(0))
        depth = dr.select(hit, dr.norm(si.p - ray.o), 0)
        normal = dr.select(hit, si.sh_frame.n, 0)
        return PathSample(mi.Spectrum(alpha), alpha, [depth, normal.x, normal.y, normal.z])

    def boundary_terms(
        self, scene: mi.Scene, tables: list[tuple[mi.Mesh, EdgeTable]], sensor: mi.Sensor, seed: int
    ) -> Iterable[BoundaryTerm]:
        """None: the AOVs of the first hit jump at silhouettes only."""
        return ()

    def replays(self, scene: mi.Scene) -> bool:
        """See ``GShellPathIntegrator.replays``."""
        return False

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
        """See ``GShellPathIntegrator.attached``."""
        now = self.primal(scene, sampler, ray)
        if mode == dr.ADMode.Backward:
            return on_sample(now.value, now.alpha, now.aovs), now
        dr.forward_to(*now.aovs, *film_terms, flags=dr.ADFlag.ClearEdges)
        zero = dr.zeros(mi.Float, dr.width(now.alpha))
        tangents = on_sample(mi.Spectrum(zero), zero, [mi.Float(dr.grad(x)) for x in now.aovs])
        return tangents, [dr.grad(x) for x in film_terms]

    def to_string(self) -> str:
        return f"GShellMaskIntegrator[warp_radius={self.warp_radius}]"


mi.register_integrator("gshell_mask", lambda props: GShellMaskIntegrator(props))
