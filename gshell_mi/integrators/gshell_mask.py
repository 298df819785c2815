"""The silhouette and AOV integrator ``gshell_mask``."""

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from . import reparameterised_film
from .path_sample import PathSample
from .supported_scenes import check_meshes


class GShellMaskIntegrator(ADIntegrator):
    """Coverage, depth and shading normal of the first hit, with derivatives of the silhouette.

    Colour and alpha are 1 on every shape and 0 elsewhere. The AOVs are the distance to the sensor
    (scene units) and the shading normal in world space, both 0 where nothing is hit.

    Plugin parameters: ``warp_radius``, ``cull_hidden`` and ``crease_angle``, as for ``gshell_path``.

    .. code-block:: xml

        <integrator type="gshell_mask"/>

    .. code-block:: python

        integrator = mi.load_dict({'type': 'gshell_mask'})
    """

    #: What hits nothing is black.
    hide_emitters = True

    def __init__(self, props):
        super().__init__(props)
        self.warp_radius = props.get("warp_radius", 2.0)
        self.cull_hidden = props.get("cull_hidden", True)
        self.said = set()   # warnings given so far
        self.crease_angle = props.get("crease_angle", 0.1)

    def aov_names(self):
        return ["depth", "normal.x", "normal.y", "normal.z"]

    def sample(self, mode, scene, sampler, ray, active=True, **kwargs):
        check_meshes(scene)
        result = self.primal(scene, sampler, ray, active)
        return result.value, result.alpha > 0.5, result.aovs, None

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        return reparameterised_film.render_forward(self, scene, sensor, seed, spp)

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        reparameterised_film.render_backward(self, scene, grad_in, sensor, seed, spp)

    def primal(self, scene, sampler, ray, active=True):
        """The first hit along camera rays; attached to whatever ``ray`` and the scene are."""
        with dr.suspend_grad():
            pi = scene.ray_intersect_preliminary(dr.detach(mi.Ray3f(ray)), coherent=True, active=active)
        si = pi.compute_surface_interaction(mi.Ray3f(ray), mi.RayFlags.All)
        hit = si.is_valid()
        alpha = dr.select(hit, mi.Float(1), mi.Float(0))
        depth = dr.select(hit, dr.norm(si.p - ray.o), 0)
        normal = dr.select(hit, si.sh_frame.n, 0)
        return PathSample(mi.Spectrum(alpha), alpha, [depth, normal.x, normal.y, normal.z])

    def boundary_terms(self, scene, tables, sensor, seed):
        """None: the AOVs of the first hit jump at silhouettes only."""
        return ()

    def replays(self, scene):
        """See ``GShellPathIntegrator.replays``."""
        return False

    def attached(self, mode, scene, sampler, ray, state, on_sample, film_terms=()):
        """See ``GShellPathIntegrator.attached``."""
        now = self.primal(scene, sampler, ray)
        if mode == dr.ADMode.Backward:
            return on_sample(now.value, now.alpha, now.aovs), now
        dr.forward_to(*now.aovs, *film_terms, flags=dr.ADFlag.ClearEdges)
        zero = dr.zeros(mi.Float, dr.width(now.alpha))
        tangents = on_sample(mi.Spectrum(zero), zero, [mi.Float(dr.grad(x)) for x in now.aovs])
        return tangents, [dr.grad(x) for x in film_terms]

    def to_string(self):
        return f"GShellMaskIntegrator[warp_radius={self.warp_radius}]"


mi.register_integrator("gshell_mask", lambda props: GShellMaskIntegrator(props))
