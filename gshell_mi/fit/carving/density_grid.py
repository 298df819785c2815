"""A dense grid of density and radiance inside the visual hull: where is something, where is nothing?

A surface that starts at the hull sinks into a fold only where a small step already explains the images
better, so deep pleats and keyholes stay bridged. A fog has no such start: it thins wherever the views
disagree and thickens where they agree (Mildenhall et al., ECCV 2020; on a grid: Sun et al., CVPR 2022). The
radiance does *not* depend on the direction: with a directional part the fog of a bridge can show every view
what it wants to see, and stays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from ...activations import sigmoid, softplus
from ...compat import mesh_scene
from ...images import decibels
from ...pixels import PixelPool
from ...views import PinholeViews
from ..bookkeeping.observer import Preview
from ..radiance.contrast import Contrast
from ..radiance.lanes import chosen_lanes

if TYPE_CHECKING:
    from ..stages.cavities import CavitiesConfig

#: Length of a step along a ray, in cells.
_STEP = 0.5

#: Rays end where they are this dark.
_DARK = 0.01

#: Fraction of the steps that a volume of half the resolution makes first: it sees farther.
_COARSE_STEPS = 0.4

#: The densities' logit at the start (about 0.13 optical depth per cell), and outside the hull.
_FOG, _EMPTY = -2.0, -30.0

#: Weight of the coverage's squared error beside that of the radiance.
_MASK = 0.3

#: Batches of rays that look where transmittance is high.
_SURVEY = 8

#: A run's random rays of the survey must not be those of its steps.
_SURVEY_STEP = 1 << 20

#: Random numbers of where rays begin, apart from those of the lookups.
_JITTER = 1 << 30


class DensityGrid:
    """Density and radiance at lattice vertices, trained on random pixels.

    Rays pick one of the eight vertices around each sample at random, by the weights of the trilinear
    interpolation (stochastic filtering): eight times fewer memory accesses, and the noise averages out.

    Args:
        hull: (n + 1, n + 1, n + 1) signed distances to the visual hull at the vertices of the cube
            [-1, 1]^3, z by y by x, lattice units.
        vertices, faces: the hull's surface in world units, where rays enter.
        to_world: from the cube to the world.
        views: the cameras.
        pixels: the targets' pixels.
        config: how it is trained.
        first: the step to begin with; that of a resumed run.
        seed: of all random numbers.
    """

    def __init__(
        self,
        hull: np.ndarray,
        vertices: np.ndarray,
        faces: np.ndarray,
        to_world: mi.ScalarTransform4f,
        views: PinholeViews,
        pixels: PixelPool,
        config: CavitiesConfig,
        first: int = 0,
        *,
        seed: int = 0,
    ):
        self.hull, self.views, self.pixels, self.config = hull, views, pixels, config
        self.seed = seed
        self.hull_surface = vertices, faces
        self.to_lattice = mi.Transform4f(to_world).inverse()
        self.scene = mesh_scene(vertices, faces)
        self.coarse_steps = round(_COARSE_STEPS * config.iterations)
        self.mean_radiance = pixels.mean_radiance()
        self._tone = Contrast(self.mean_radiance)
        #: By name; another one after the coarse steps.
        self.optimizers: dict[str, mi.ad.Adam] = {}
        full = len(hull) - 1
        self._begin(full if first > self.coarse_steps else full // 2)

    def step(self, iteration: int) -> dict[str, float]:
        """One Adam step on random rays through the hull; returns the losses."""
        config, full = self.config, len(self.hull) - 1
        if iteration >= self.coarse_steps and self.resolution < full:
            self._refine(full)
        fine = self.resolution == full
        begin, end = (self.coarse_steps, config.iterations) if fine else (0, self.coarse_steps)
        decay = (0.1 if fine else 0.5) ** ((iteration - begin) / max(end - begin, 1))
        optimizer = self.optimizers["volume"]
        optimizer.set_learning_rate(
            {"density": decay * config.lr, "radiance": decay * config.radiance_lr * self.mean_radiance}
        )
        rays, target, alpha = self._rays(iteration)
        radiance, transmittance = self._march(rays, iteration)
        dr.eval(radiance, transmittance)
        dr.enable_grad(radiance, transmittance)
        image = dr.sum(dr.ravel(dr.square(self._tone(radiance) - self._tone(target))))
        mask = dr.sum(dr.square(1 - transmittance - alpha))
        weight = self.pixels.mask_weight(_MASK)
        dr.backward(image + weight * mask)
        adjoint = *dr.detach((radiance, transmittance)), dr.grad(radiance), dr.grad(transmittance)
        gradient = dr.unravel(mi.Vector4f, self._march(rays, iteration, adjoint=adjoint))
        slope = self._allowed * sigmoid(dr.detach(optimizer["density"]))
        dr.set_grad(optimizer["density"], slope * gradient.w)
        dr.set_grad(optimizer["radiance"], dr.ravel(mi.Vector3f(gradient.x, gradient.y, gradient.z)))
        optimizer.step()
        count = max(dr.width(transmittance), 1)
        error = dr.sum(dr.ravel(dr.square(adjoint[0] - target)))
        image, mask = image[0] / count, mask[0] / count
        return {
            "loss": image + weight * mask,
            "image": image,
            "mask": mask,
            "psnr": decibels(error[0] / (3 * count)),
        }

    def opacity(self) -> np.ndarray:
        """(n + 1, n + 1, n + 1) opacity of one cell's length, in [0, 1]."""
        depth = softplus(dr.detach(self.optimizers["volume"]["density"])) * self._allowed
        return self._cube(1 - dr.exp(-depth))

    def seen(self) -> np.ndarray:
        """(n + 1, n + 1, n + 1) fraction of the rays near a vertex that reach it half bright.

        Vertices that hardly a ray comes near are not seen.
        """
        bright, all_rays = (dr.zeros(mi.Float, dr.width(self._allowed)) for _ in range(2))
        for batch in range(_SURVEY):
            rays, _, _ = self._rays(_SURVEY_STEP + batch)
            dr.eval(self._march(rays, _SURVEY_STEP + batch, survey=(bright, all_rays)), bright, all_rays)
        return self._cube(dr.select(all_rays > 5, bright / all_rays, 0))

    def preview(self) -> Preview:
        """The hull: a fog has no surface yet."""
        vertices, faces = self.hull_surface
        return Preview(vertices, faces, np.full_like(vertices, self.mean_radiance), vertices, faces)

    # --- grids

    def _begin(
        self, resolution: int, density: np.ndarray | None = None, radiance: np.ndarray | None = None
    ) -> None:
        """Grids of a resolution: even fog, or what is given."""
        self.resolution = resolution
        hull = self.hull
        if resolution != len(hull) - 1:
            hull = ndimage.zoom(hull, (resolution + 1) / len(hull), order=1)
        allowed = hull < 2 / resolution
        if density is None:
            density = np.full(allowed.shape, _FOG)
            radiance = np.full((*allowed.shape, 3), self.mean_radiance)
        density = np.where(allowed, density, _EMPTY)
        self._allowed = mi.Float(allowed.ravel().astype(np.float32))
        optimizer = mi.ad.Adam(lr=self.config.lr, beta_2=0.99)
        optimizer["density"] = mi.Float(density.ravel().astype(np.float32))
        optimizer["radiance"] = mi.Float(radiance.ravel().astype(np.float32))
        self.optimizers["volume"] = optimizer

    def _refine(self, resolution: int) -> None:
        """Goes on at another resolution."""
        optimizer, old = self.optimizers["volume"], self.resolution + 1
        factor = (resolution + 1) / old
        density = np.maximum(optimizer["density"].numpy(), 2 * _FOG).reshape(old, old, old)
        radiance = optimizer["radiance"].numpy().reshape(old, old, old, 3)
        self._begin(
            resolution,
            ndimage.zoom(density, factor, order=1),
            ndimage.zoom(radiance, (factor, factor, factor, 1), order=1),
        )

    def _cube(self, values: mi.Float) -> np.ndarray:
        return values.numpy().reshape((self.resolution + 1,) * 3)

    # --- rays

    def _rays(self, step: int) -> tuple[tuple, mi.Color3f, mi.Float]:
        """Random pixels' rays that meet the hull: origins, directions, first and last distance on the
        lattice; and the targets' radiance and coverage."""
        sample = self.pixels.sample(self.config.batch, seed=self.seed, step=step)
        ray = self.views.rays(sample.view, sample.film)
        hit = self.scene.ray_intersect_preliminary(ray, coherent=False)
        values = ray.o, ray.d, hit.t, sample.radiance, sample.alpha
        index = chosen_lanes(hit.is_valid(), values)
        if not dr.width(index):
            index = mi.UInt32(0)  # a ray without steps: arrays are never empty
        # The others have nothing to march through.
        origin, direction, t, target, alpha = (dr.gather(type(value), value, index) for value in values)
        origin, direction = self.to_lattice @ origin, self.to_lattice @ direction
        length = dr.norm(direction)
        direction = mi.Vector3f(direction / length)
        cell = dr.opaque(mi.Float, 2 / self.resolution)
        jitter = self._random(dr.width(t), step + _JITTER).next_float32()
        first = dr.maximum(t * length + (jitter * _STEP - 0.5) * cell, 0)
        far = dr.maximum((-1 - origin) / direction, (1 - origin) / direction)
        rays = origin, direction, first, dr.min(far)
        dr.eval(rays, target, alpha)
        return rays, target, alpha

    def _random(self, count: int, step: int) -> mi.PCG32:
        """Random numbers of one step, as many at a time."""
        return mi.PCG32(size=count, initstate=dr.opaque(mi.UInt64, (self.seed << 32) + step))

    def _march(self, rays: tuple, step: int, *, adjoint: tuple | None = None, survey: tuple | None = None):
        """Composites the volume along rays.

        Args:
            rays: from ``_rays``.
            step: whose random numbers filter.
            adjoint: the radiance and transmittance that the same call without it gave, and the loss's
                derivatives by both; the call then replays the rays (Vicini et al., SIGGRAPH 2021).
            survey: sums, by vertex, of the rays that reach it bright and of all.

        Returns:
            Radiance and transmittance; with ``adjoint`` the derivative by radiance and optical depth of a
            cell, four values per vertex.
        """
        origin, direction, first, last = rays
        optimizer, n = self.optimizers["volume"], self.resolution
        density, radiance = dr.detach(optimizer["density"]), dr.detach(optimizer["radiance"])
        # One packet per vertex is one memory access.
        red, green, blue = dr.unravel(mi.Vector3f, radiance)
        values = dr.ravel(mi.Vector4f(red, green, blue, softplus(density) * self._allowed))
        gradient = dr.zeros(mi.Float, dr.width(values)) if adjoint else None
        dr.eval(values)
        cells, side = dr.opaque(mi.Float, n), dr.opaque(mi.UInt32, n + 1)
        length = dr.opaque(mi.Float, _STEP * 2 / n)

        def body(t, transmittance, total, active, random):
            index = _nearby_vertex((origin + t * direction + 1) * (0.5 * cells), cells, side, random)
            value = dr.gather(mi.Vector4f, values, index, active)
            remaining = transmittance * dr.exp(-_STEP * value.w)
            weight = transmittance - remaining
            color = dr.maximum(mi.Color3f(value.x, value.y, value.z), 0)
            total = dr.select(active, total + weight * color, total)
            if survey:
                bright = dr.select(transmittance > 0.5, mi.Float(1), 0)
                for sums, share in zip(survey, (bright, mi.Float(1)), strict=True):
                    dr.scatter_reduce(dr.ReduceOp.Add, sums, share, index, active)
            if adjoint:
                final, final_transmittance, by_radiance, by_transmittance = adjoint
                behind = dr.dot(final - total, by_radiance) + final_transmittance * by_transmittance
                by_depth = _STEP * (remaining * dr.dot(color, by_radiance) - behind)
                by_color = dr.select(color > 0, weight * by_radiance, 0)
                dr.scatter_reduce(
                    dr.ReduceOp.Add,
                    gradient,
                    mi.Vector4f(by_color.x, by_color.y, by_color.z, by_depth),
                    index,
                    active,
                )
            transmittance = dr.select(active, remaining, transmittance)
            t = t + length
            return t, transmittance, total, active & (t < last) & (transmittance > _DARK), random

        count = dr.width(first)
        state = (
            mi.Float(first),
            dr.full(mi.Float, 1, count),
            dr.zeros(mi.Color3f, count),
            first < last,
            self._random(count, step),
        )
        _, transmittance, total, _, _ = dr.while_loop(state, lambda t, tr, c, active, r: active, body)
        return gradient if adjoint else (total, transmittance)


def _nearby_vertex(position: mi.Point3f, cells: mi.Float, side: mi.UInt32, random: mi.PCG32) -> mi.UInt32:
    """One of the eight vertices around a position, with the probability of its trilinear weight."""
    bits = random.next_uint32()
    uniform = (mi.Float((bits >> shift) & 0x3FF) / 1024 for shift in (2, 12, 22))
    x, y, z = (
        mi.UInt32(dr.clip(dr.floor(coordinate + u), 0, cells))
        for coordinate, u in zip(position, uniform, strict=True)
    )
    return x + side * (y + side * z)
