"""How well the light explains what is seen of a template, and how well what lies behind it would.

From the joint stage on, light and material say how bright a place is that no image was fitted to, such as the
inside of a pleat behind its cap. So both can be compared with the targets: the surface as it is, and what
there would be to see without it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...compat import mesh_scene
from ...extraction.surface_mesh import SurfaceMesh
from ...fields.smoothing import MeshDiffusion
from ...pixels import COVERED, PixelPool
from ...template.growth import grown_apart
from ...views import PinholeViews
from ..radiance.lanes import chosen_lanes

#: Pixels per batch, and batches.
_BATCH, _BATCHES = 65536, 24

#: Share of the mean radiance that is added to a target's before errors are related to it. Small, as what is
#: dark tells caps from what is behind them.
_FLOOR = 0.1

#: Samples brighter than this multiple of the mean radiance count as so bright: fireflies tell nothing.
_BRIGHTEST = 4.0

#: Weight of the coverage's squared error.
_COVERAGE = 3.0

#: How far behind the template rays go on, as a fraction of its extent.
_OFFSET = 1e-4


#: Least share of the rays, smoothed, that a vertex meets of those which half of the surface meets. What few
#: views see into may as well be a fold whose shape is not known.
_SEEN = 0.5

#: What is to be opened is explained worse than most of the surface by this factor ...
_WORSE = 1.5

#: ... and what is behind it, which nothing was fitted to yet, worse than it by at most this one. Behind what
#: is really there it is dozens of times as bad.
_BEHIND = 4.0


@dataclass(frozen=True)
class Residuals:
    """Sums over random rays, by the vertices of the template where they meet it first.

    Attributes:
        rays: (V,) how many.
        now: (V,) squared errors of the scene as it is. Their expectation is free of the noise of path
            tracing, so sums over few rays may be negative.
        without: (V,) squared errors of what would be seen if nothing were where the rays meet the template;
            0 if that was not asked for.
    """

    rays: np.ndarray
    now: np.ndarray
    without: np.ndarray


def residuals_of(template: SurfaceMesh, scene: mi.Scene, integrator, views: PinholeViews, pixels: PixelPool,
                 seed: int, *, behind: bool = True) -> Residuals:
    """Compares a scene, with and without its template, with the targets' wholly covered pixels.

    Args:
        template: watertight, world units, not empty.
        scene: whose subject is cut from the template.
        integrator: a ``gshell_path`` that hides emitters.
        views, pixels: the targets.
        seed: of the pixels and the paths.
        behind: whether to ask for what would be seen without the template, which is half of the work.
    """
    with dr.suspend_grad():
        vertices, faces, _ = template.to_numpy()
        shell, corners = mesh_scene(vertices, faces), mi.Vector3u(template.faces)
        offset = dr.opaque(mi.Float, _OFFSET * float(np.ptp(vertices, axis=0).max()))
        mean_radiance = dr.opaque(mi.Float, pixels.mean_radiance())
        coverage = dr.opaque(mi.Float, pixels.mask_weight(_COVERAGE))
        sums = [dr.zeros(mi.Float, len(vertices)) for _ in range(3)]
        for batch in range(_BATCHES):
            sample = pixels.sample(_BATCH, seed=seed, step=batch)
            ray = views.rays(sample.view, sample.film)
            hit = shell.ray_intersect_preliminary(ray, coherent=False)
            met = ray.o, ray.d, hit.t, hit.prim_index, hit.prim_uv, sample.radiance
            index = chosen_lanes(hit.is_valid() & (sample.alpha > COVERED), met)
            if dr.width(index) == 0:
                continue
            origin, direction, distance, prim, uv, target = (dr.gather(type(value), value, index)
                                                             for value in met)
            rays = [mi.Ray3f(origin, direction)]
            if behind:
                rays.append(mi.Ray3f(origin + direction * (distance + offset), direction))
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(dr.opaque(mi.UInt32, (seed * _BATCHES + batch) % 2**32), dr.width(index))
            errors = [_squared_error(scene, integrator, sampler, seen, target, mean_radiance, coverage)
                      for seen in rays]
            face = dr.gather(mi.Vector3u, corners, prim)
            weights = 1 - uv.x - uv.y, uv.x, uv.y
            # Without what is behind there are two sums.
            for total, values in zip(sums, (mi.Float(1), *errors), strict=False):
                for weight, vertex in zip(weights, face, strict=True):
                    dr.scatter_reduce(dr.ReduceOp.Add, total, weight * values, vertex)
            dr.eval(sums)
        return Residuals(*(total.numpy() for total in sums))


def near_openings(values: np.ndarray, vertices: np.ndarray, faces: np.ndarray, found: Residuals,
                  smooth: MeshDiffusion, reach: float) -> np.ndarray:
    """(V,) vertices near openings without which the images would be explained about as well.

    Args:
        values: (V,) negative where the template is open.
        vertices, faces: (V, 3) and (F, 3) of the watertight template.
        found: how well the images are explained through each vertex.
        smooth: along the template.
        reach: the longest way along the template between an opening and what opens apart from it, in the
            unit of the vertices.
    """
    solid = values > 0
    rays, now, without = (smooth(mi.Float(sums.astype(np.float32))).numpy()
                          for sums in (found.rays, found.now, found.without))
    met = solid & (rays > 0)
    if not met.any():
        return met
    met &= rays > _SEEN * np.median(rays[met])
    typical = np.median(now[met] / rays[met])
    empty = met & (now > _WORSE * typical * rays) & (without < _BEHIND * now)
    ratio = np.where(empty, without / np.maximum(now, 1e-30), _BEHIND)
    return grown_apart(solid, empty, ratio, vertices, faces, reach)


def _squared_error(scene: mi.Scene, integrator, sampler: mi.Sampler, ray: mi.Ray3f, target: mi.Color3f,
                   mean_radiance: mi.Float, coverage: mi.Float) -> mi.Float:
    """The product of two independent paths' errors: its mean is the square of the mean error."""
    errors = []
    for _ in range(2):
        path = integrator.primal(scene, sampler, ray, max_depth=integrator.max_depth)
        seen = dr.minimum(mi.Color3f(path.value), _BRIGHTEST * mean_radiance)
        errors.append(((seen - target) / (target + _FLOOR * mean_radiance), path.alpha - 1))
        # Each path is a run of the same kernel.
        dr.eval(errors)
    (first, missing), (second, missing_too) = errors
    return dr.dot(first, second) + coverage * missing * missing_too
