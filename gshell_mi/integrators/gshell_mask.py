"""The silhouette and AOV integrator ``gshell_mask``."""

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator


class GShellMaskIntegrator(ADIntegrator):
    """Coverage, depth and shading normal of the first hit."""

    def aov_names(self):
        return ["depth", "normal.x", "normal.y", "normal.z"]

    def sample(self, mode, scene, sampler, ray, active, **kwargs):
        si = scene.ray_intersect(dr.detach(ray), active)
        hit = si.is_valid()
        value = dr.select(hit, mi.Spectrum(1), mi.Spectrum(0))
        depth = dr.select(hit, dr.norm(si.p - dr.detach(ray.o)), 0)
        normal = dr.select(hit, si.sh_frame.n, 0)
        return value, hit, [depth, normal.x, normal.y, normal.z], None


mi.register_integrator("gshell_mask", lambda props: GShellMaskIntegrator(props))
