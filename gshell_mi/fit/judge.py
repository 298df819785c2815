"""Which of two surfaces explains the images better: the same unseen rays through both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import losses
from ..compat import mesh_scene
from ..fields.smoothing import MeshDiffusion
from ..pixels import COVERED, PixelPool
from ..targets import Target
from ..views import PinholeViews

if TYPE_CHECKING:
    from .config import FitConfig

#: Pixels this near to a mask's outline do not judge: where a surface ends to a cell is found later.
_OUTLINE = 3

#: Batches of rays that tell the colours, and that judge.
_LEARNT, _JUDGED = 60, 20

#: Lambda that spreads colours along a mesh to vertices that hardly a ray comes near.
_SMOOTHING = 0.5

#: Standard errors by which a change has to be better.
_SURE = 2.0


@dataclass(frozen=True)
class Verdict:
    """How much better a surface after a change explains unseen views.

    Attributes:
        before, after: mean error of a ray.
        gain: mean, over the unseen views, of the error before less that after.
        noise: standard error of the gain. Views are independent of each other, rays of one view are not.
    """

    before: float
    after: float
    gain: float
    noise: float

    @property
    def accepted(self) -> bool:
        """Whether the gain is no accident."""
        return self.gain > _SURE * self.noise


def judge(before: tuple[np.ndarray, np.ndarray], after: tuple[np.ndarray, np.ndarray], views: PinholeViews,
          targets: list[Target], config: FitConfig) -> Verdict:
    """Compares two surfaces, each given as vertices (V, 3) and faces (F, 3).

    Each has the mean colour that half of the views show it in, of one side and of the other, and the other
    half judges; then the other way round. Whatever neither can explain so, such as gloss, texture finer than
    the meshes, poses and noise, is in both errors and cancels in their difference.

    Args:
        views, targets: the images. Pixels beside the masks' outlines do not count.
    """
    every, errors = np.arange(len(views)), []
    for half in (every[::2], every[1::2]):
        other = np.setdiff1d(every, half) if len(every) > 1 else every
        if not len(half):
            continue
        known, unknown = PixelPool(views, targets, other), PixelPool(views, targets, half, _OUTLINE)
        (rays, first), (_, second) = (_errors_by_view(surface, views, known, unknown, config)
                                      for surface in (before, after))
        errors.append(np.stack([first[half], second[half]])[:, rays[half] > 0] / rays[half][rays[half] > 0])
    errors = np.concatenate(errors, axis=1)
    difference = errors[0] - errors[1]
    noise = difference.std(ddof=1) / np.sqrt(len(difference)) if len(difference) > 1 else np.inf
    return Verdict(float(errors[0].mean()), float(errors[1].mean()), float(difference.mean()), float(noise))


def _errors_by_view(surface: tuple[np.ndarray, np.ndarray], views: PinholeViews, known: PixelPool,
                    unknown: PixelPool, config: FitConfig) -> tuple[np.ndarray, np.ndarray]:
    """(N,) rays of each view and the sums of their errors."""
    vertices, faces = surface
    scene, corners = mesh_scene(vertices, faces), mi.UInt32(faces.astype(np.uint32).ravel())
    sums = [dr.zeros(mi.Float, 2 * len(vertices)) for _ in range(4)]
    rays, errors = (dr.zeros(mi.Float, len(views)) for _ in range(2))
    with dr.suspend_grad():
        for step in range(_LEARNT):
            sample = known.sample(config.radiance.batch, seed=config.seed, step=step)
            whole = sample.alpha > COVERED
            for index, weight, hit in _sides(scene, corners, views.rays(sample.view, sample.film)):
                for total, value in zip(sums, (*sample.radiance, mi.Float(1)), strict=True):
                    dr.scatter_reduce(dr.ReduceOp.Add, total, weight * value, index, hit & whole)
            dr.eval(sums)
        colors = _means(sums, faces, len(vertices))
        coverage = dr.opaque(mi.Float, 3 * unknown.mask_weight(1.0))
        for step in range(_JUDGED):
            sample = unknown.sample(config.radiance.batch, seed=config.seed, step=step)
            radiance, alpha = mi.Color3f(0), mi.Float(0)
            for index, weight, hit in _sides(scene, corners, views.rays(sample.view, sample.film)):
                radiance += weight * mi.Color3f(*(dr.gather(mi.Float, color, index, hit) for color in colors))
                alpha = dr.select(hit, 1, alpha)
            error = dr.abs(losses.tonemap(radiance) - losses.tonemap(sample.radiance))
            error = dr.sum(error) + coverage * dr.abs(alpha - sample.alpha)
            dr.scatter_reduce(dr.ReduceOp.Add, rays, mi.Float(1), sample.view)
            dr.scatter_reduce(dr.ReduceOp.Add, errors, error, sample.view)
            dr.eval(rays, errors)
    return rays.numpy(), errors.numpy()


def _sides(scene: mi.Scene, corners: mi.UInt32, ray: mi.Ray3f) -> list[tuple[mi.UInt32, mi.Float, mi.Bool]]:
    """What rays meet first: the three vertices, even numbers from the front and odd ones from the back, their
    weights, and whether anything is met."""
    found = scene.ray_intersect_preliminary(ray, coherent=False)
    dr.eval(found)
    hit = found.is_valid()
    back = dr.dot(found.compute_surface_interaction(ray, mi.RayFlags.Minimal, hit).n, ray.d) > 0
    uv = dr.select(hit, found.prim_uv, 0)
    weights = (1 - uv.x - uv.y, uv.x, uv.y)
    vertices = (dr.gather(mi.UInt32, corners, 3 * found.prim_index + corner, hit) for corner in range(3))
    return [(2 * vertex + dr.select(back, mi.UInt32(1), 0), weight, hit)
            for vertex, weight in zip(vertices, weights, strict=True)]


def _means(sums: list[mi.Float], faces: np.ndarray, count: int) -> list[mi.Float]:
    """(2 V,) mean red, green and blue of each vertex' sides, from weighted sums and the weights."""
    smooth = MeshDiffusion(faces, count, _SMOOTHING)
    side = 2 * dr.arange(mi.UInt32, count)
    means = [dr.zeros(mi.Float, 2 * count) for _ in range(3)]
    for back in range(2):
        *colors, weight = (dr.maximum(smooth(dr.gather(mi.Float, total, side + back)), 0) for total in sums)
        for mean, color in zip(means, colors, strict=True):
            dr.scatter(mean, color / dr.maximum(weight, 1e-6), side + back)
    dr.eval(means)
    return means
