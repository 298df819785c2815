"""A radiance volume in sparse voxels: which windows, struts and gaps does no hull show?

A surface that starts at the visual hull and moves locally never finds windows, struts or the gaps between
leaves. A fog has no such start: it thins wherever the views disagree and thickens where they agree
(Mildenhall et al., ECCV 2020; on voxels Sun et al. and Fridovich-Keil et al., CVPR 2022).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from ..activations import inverse_softplus, sigmoid, softplus
from ..bricks import BRICK, Bricks
from ..images import decibels
from ..pixels import PixelPool
from ..preview import Preview
from ..views import PinholeViews
from .config import TrainingConfig
from .contrast import Contrast
from .marching import Adjoint, Rays, composite, depth_along

#: Steps of the last level over those of each other one.
_LAST = 1.5

#: Neighbouring pixels that are drawn together: what they see is near in memory.
_TOGETHER = 4

#: Rays per pixel. The error of one weighs the derivative of the other, so that the noise of their random
#: lookups is not taken for an error of the image.
_RAYS = 2

#: Optical depth of a voxel at the start, and the logit of one that is empty.
_FOG, _EMPTY = 0.13, -10.0

#: Logits at the start of a level: what was empty may fill, and what was opaque thin out.
_LOGITS = -6.0, 6.0

#: Voxels this far outside of the visual hull, in voxels of the first level, are empty.
_OUTSIDE = 1.5

#: The next level has voxels around those that give some ray this share of its light.
_SHARE = 0.1

#: Batches of rays that look for them; random numbers apart from those of the steps.
_SURVEY, _SURVEY_STEP = 16, 1 << 20

#: Numbers per voxel of each parameter.
_CHANNELS = {"density": 1, "radiance": 3, "direction": 9}

#: Fraction of what depends on the direction that a step takes away: it explains gloss, and no geometry.
_DIRECTION_DECAY = 0.002


class RadianceVolume:
    """Density and radiance in sparse voxels, trained on random pixels from coarse to fine.

    The radiance of a voxel is linear in the direction of the ray, but for the first level, where it does not
    depend on it, as in all of a volume whose ``direction_lr`` is 0. Rays read one of the eight voxels around
    each sample at random, by the weights of the trilinear interpolation (stochastic filtering): eight times
    fewer memory accesses, and the noise averages out.

    Args:
        hull: (n, n, n) signed distances to the visual hull at the centres of the first level's voxels, in the
            cube [-1, 1]^3, z by y by x.
        to_world: from the cube to the world.
        views: the cameras.
        pixels: the targets' pixels.
        config: how it is trained.
        sides: voxels per side of each level (``sides_of_levels``).
        surface: vertices (V, 3) and faces (F, 3) to show meanwhile, world units.
        stored: what ``arrays`` gave, of a run to go on with.
        seed: of all random numbers.
    """

    def __init__(
        self,
        hull: np.ndarray,
        to_world: mi.ScalarTransform4f,
        views: PinholeViews,
        pixels: PixelPool,
        config: TrainingConfig,
        sides: Sequence[int],
        surface: tuple[np.ndarray, np.ndarray],
        stored: Mapping[str, np.ndarray] | None = None,
        *,
        seed: int = 0,
    ):
        self.seed = seed
        self.views, self.pixels, self.config, self.surface = views, pixels, config, surface
        self.to_lattice = mi.Transform4f(to_world).inverse()
        self.mean_radiance = pixels.mean_radiance()
        self._tone = Contrast(self.mean_radiance)
        self._hull = mi.Texture3f(
            mi.TensorXf(hull[..., None].astype(np.float32)), wrap_mode=dr.WrapMode.Clamp
        )
        self._reach = _OUTSIDE * 2 / len(hull)
        self._sides = sides
        shares = np.append(np.ones(len(sides) - 1), _LAST)
        counts = np.round(shares / shares.sum() * config.iterations)
        #: The first step of each level, and the end of all.
        self._begins = [0, *(int(step) for step in np.cumsum(counts))]
        #: By name; another one on each level.
        self.optimizers: dict[str, mi.ad.Adam] = {}
        if stored and "volume_places" in stored:
            self.level = int(stored["volume_level"])
            self._begin(Bricks.at(stored["volume_places"], self._sides[self.level]))
        else:
            self.level = 0
            near = hull < self._reach
            m = self._sides[0] // BRICK
            bricks = np.any(near.reshape(m, BRICK, m, BRICK, m, BRICK), axis=(1, 3, 5))
            self._begin(Bricks.where(bricks))

    def arrays(self) -> dict[str, np.ndarray]:
        """Which voxels there are, for a run to go on with."""
        return {"volume_places": self.bricks.places.astype(np.int16), "volume_level": np.array(self.level)}

    def step(self, iteration: int) -> dict[str, float]:
        """One Adam step; returns the losses."""
        config = self.config
        while self.level + 1 < len(self._sides) and iteration >= self._begins[self.level + 1]:
            self._refine()
        rays, target, alpha = self._rays(iteration)
        packets = self._packets()
        seen = composite(self.bricks, packets, rays, self._seed_of(iteration))
        dr.eval(seen.radiance, seen.transmittance, seen.spread)
        dr.enable_grad(seen.radiance, seen.transmittance)
        other = dr.arange(mi.UInt32, dr.width(alpha)) ^ 1
        error, missing = self._tone(seen.radiance) - self._tone(target), 1 - seen.transmittance - alpha
        image = dr.sum(dr.dot(error, dr.gather(mi.Color3f, dr.detach(error), other)))
        mask = dr.sum(missing * dr.gather(mi.Float, dr.detach(missing), other))
        weight = self.pixels.mask_weight(config.mask)
        dr.backward(image + weight * mask)
        adjoint = Adjoint(
            dr.detach(seen.radiance),
            dr.detach(seen.transmittance),
            seen.spread,
            dr.grad(seen.radiance),
            dr.grad(seen.transmittance),
            dr.opaque(mi.Float, config.distortion),
        )
        gradient = composite(self.bricks, packets, rays, self._seed_of(iteration), adjoint=adjoint)
        self._descend(gradient, iteration)
        count = max(dr.width(alpha), 1)
        image, mask = image[0] / count, mask[0] / count
        return {
            "loss": image + weight * mask,
            "image": image,
            "mask": mask,
            "psnr": decibels(max(image / 3, 1e-9)),
        }

    def preview(self) -> Preview:
        """The surface before: a fog has none yet."""
        vertices, faces = self.surface
        return Preview(vertices, faces, np.full_like(vertices, self.mean_radiance), vertices, faces)

    # --- what it holds

    def depths(self) -> Iterator[np.ndarray]:
        """Of each view (height, width) distance along the ray through each pixel's centre, in world units, at
        which half of the light is blocked; infinite where less ever is."""
        packets = self._packets()
        for view, (width, height) in enumerate(self.views.sizes):
            ray = self.views.pixel_rays(view)
            found = depth_along(self.bricks, packets, Rays.through(self.bricks, self.to_lattice @ ray))
            yield (found / dr.norm(self.to_lattice @ ray.d)).numpy().reshape(height, width)

    def radiance_at(self, points: np.ndarray) -> np.ndarray:
        """(V, 3) radiance at (V, 3) world positions, averaged over directions; 0 where nothing is."""
        position = self.to_lattice @ mi.Point3f(np.ascontiguousarray(points.T, np.float32))
        (values,) = self._resampled(position, {"radiance": 3})
        return np.maximum(values.numpy().reshape(-1, 3), 0)

    def opacity_at(self, points: mi.Point3f, length: float) -> mi.Float:
        """Opacity of a way of some ``length`` (of the cube [-1, 1]^3) through what is at world positions; 0
        where there are no voxels."""
        voxels = dr.opaque(mi.Float, 0.5 * length * self.bricks.side)
        density, opacity = dr.detach(self.optimizers["volume"]["density"]), mi.Float(0)
        for voxel, weight in self.bricks.lookup().around(self.to_lattice @ points, mi.Bool(True)):
            opacity += weight * (1 - dr.exp(-voxels * softplus(dr.gather(mi.Float, density, voxel))))
        return opacity

    def views_seeing(self, points: mi.Point3f) -> mi.UInt32:
        """How many views more than half of the light of world positions reaches."""
        packets, start, count = self._packets(), self.to_lattice @ points, dr.width(points)
        seeing = dr.zeros(mi.UInt32, count)
        for view in range(len(self.views)):
            film, along = self.views.project(view, points)
            framed = (along > 0) & dr.all((film >= 0) & (film <= 1))
            way = self.to_lattice @ mi.Point3f(self.views.origins[view]) - start
            rays = Rays.through(self.bricks, mi.Ray3f(start, way))
            rays = replace(rays, last=dr.select(framed, dr.minimum(rays.last, dr.norm(way)), -1))
            blocked = depth_along(self.bricks, packets, rays) < dr.inf
            seeing += dr.select(framed & ~blocked, mi.UInt32(1), 0)
            dr.eval(seeing)
        return seeing

    # --- levels

    def _begin(self, bricks: Bricks, values: dict[str, mi.Float] | None = None) -> None:
        self.bricks = bricks
        count = bricks.voxel_count
        density = dr.full(mi.Float, inverse_softplus(_FOG), count) if values is None else values["density"]
        to_hull = self._hull.eval(mi.Point3f(0.5 * (bricks.centres() + 1)))[0]
        outside = to_hull > dr.opaque(mi.Float, self._reach)
        values = values or {"radiance": dr.full(mi.Float, self.mean_radiance, 3 * count)}
        if self._directional and "direction" not in values:
            values["direction"] = dr.zeros(mi.Float, 9 * count)
        self.optimizers["volume"] = mi.ad.Adam(
            lr=1.0, beta_2=0.99, params=values | {"density": dr.select(outside, _EMPTY, density)}
        )

    def _refine(self) -> None:
        """Goes on with voxels of half the size where something is."""
        side = self._sides[self.level + 1]
        shares = self.bricks.dense(self._greatest_shares())
        live = ndimage.binary_dilation(shares > _SHARE, ndimage.generate_binary_structure(3, 3))
        m = side // BRICK
        size = len(live) // m
        bricks = Bricks.where(live.reshape(m, size, m, size, m, size).any(axis=(1, 3, 5)))
        channels = {name: _CHANNELS[name] for name in self.optimizers["volume"].keys()}
        values = dict(zip(channels, self._resampled(bricks.centres(), channels), strict=True))
        # A voxel of half the length has half the optical depth; but what is opaque stays so.
        values["density"] = dr.clip(values["density"], *_LOGITS)
        self.level += 1
        self._begin(bricks, values)

    def _resampled(self, position: mi.Point3f, channels: Mapping[str, int]) -> list[mi.Float]:
        """Parameters at positions in the cube, interpolated between the voxels that there are."""
        optimizer = self.optimizers["volume"]
        nearby, count = self.bricks.lookup().around(position, mi.Bool(True)), dr.width(position)
        share = sum((weight for _, weight in nearby), mi.Float(0))
        index, results = dr.arange(mi.UInt32, count), []
        for name, size in channels.items():
            flat, values = dr.empty(mi.Float, size * count), dr.detach(optimizer[name])
            for channel in range(size):
                total = mi.Float(0)
                for voxel, weight in nearby:
                    total += weight * dr.gather(mi.Float, values, voxel * size + channel)
                dr.scatter(
                    flat, total / dr.maximum(share, 1e-3), index * size + channel, mode=dr.ReduceMode.Permute
                )
            results.append(flat)
        dr.eval(results)
        return results

    def _greatest_shares(self) -> np.ndarray:
        """Per voxel the greatest share of its light that it gives to a ray of the views."""
        greatest, packets = dr.zeros(mi.Float, self.bricks.voxel_count), self._packets()
        for batch in range(_SURVEY):
            rays, _, _ = self._rays(_SURVEY_STEP + batch)
            composite(self.bricks, packets, rays, self._seed_of(_SURVEY_STEP + batch), greatest=greatest)
            dr.eval(greatest)
        return greatest.numpy()

    # --- steps

    def _seed_of(self, step: int) -> int:
        """Of the random numbers of a step."""
        return (self.seed << 32) + step

    def _rays(self, step: int) -> tuple[Rays, mi.Color3f, mi.Float]:
        """Random pixels' rays, and the targets' radiance and coverage."""
        sample = self.pixels.sample(
            self.config.batch // _RAYS, seed=self.seed, step=step, rays=_RAYS, together=_TOGETHER
        )
        ray = self.to_lattice @ self.views.rays(sample.view, sample.film)
        return Rays.through(self.bricks, ray, jitter=self._seed_of(step)), sample.radiance, sample.alpha

    @property
    def _directional(self) -> bool:
        """Whether radiance depends on the direction. A first level would take a bridge for gloss."""
        return self.level > 0 and self.config.direction_lr > 0

    @property
    def _width(self) -> int:
        """Packets of four numbers per voxel."""
        return 4 if self._directional else 1

    def _packets(self) -> mi.Float:
        """What rays read: per voxel four numbers, radiance and optical depth, or 16 with the slopes of the
        radiance along x, y and z. One voxel is one line of the cache."""
        optimizer, voxel = self.optimizers["volume"], dr.arange(mi.UInt32, self.bricks.voxel_count)
        width = self._width
        packets = dr.empty(mi.Float, 4 * width * self.bricks.voxel_count)
        red, green, blue = dr.unravel(mi.Vector3f, dr.detach(optimizer["radiance"]))
        depth = softplus(dr.detach(optimizer["density"]))
        dr.scatter(packets, mi.Vector4f(red, green, blue, depth), width * voxel, mode=dr.ReduceMode.Permute)
        for axis in range(width - 1):
            slope = dr.gather(mi.Vector3f, dr.detach(optimizer["direction"]), 3 * voxel + axis)
            dr.scatter(
                packets,
                mi.Vector4f(slope.x, slope.y, slope.z, 0),
                width * voxel + (axis + 1),
                mode=dr.ReduceMode.Permute,
            )
        dr.eval(packets)
        return packets

    def _descend(self, gradient: mi.Float, iteration: int) -> None:
        """One step of Adam along the derivative by the packets."""
        config, optimizer, count = self.config, self.optimizers["volume"], self.bricks.voxel_count
        voxel, width = dr.arange(mi.UInt32, count), self._width
        first = dr.gather(mi.Vector4f, gradient, width * voxel)
        dr.set_grad(optimizer["density"], sigmoid(dr.detach(optimizer["density"])) * first.w)
        dr.set_grad(optimizer["radiance"], dr.ravel(mi.Vector3f(first.x, first.y, first.z)))
        begin, end = self._begins[self.level : self.level + 2]
        last = self.level == len(self._sides) - 1
        decay = (0.1 if last else 0.5) ** ((iteration - begin) / max(end - begin, 1))
        bright = decay * self.mean_radiance
        rates = {"density": decay * config.density_lr, "radiance": bright * config.radiance_lr}
        if self._directional:
            slopes = dr.empty(mi.Float, 9 * count)
            for axis in range(width - 1):
                slope = dr.gather(mi.Vector4f, gradient, width * voxel + (axis + 1))
                dr.scatter(
                    slopes,
                    mi.Vector3f(slope.x, slope.y, slope.z),
                    3 * voxel + axis,
                    mode=dr.ReduceMode.Permute,
                )
            dr.set_grad(optimizer["direction"], slopes)
            rates["direction"] = bright * config.direction_lr
        optimizer.set_learning_rate(rates)
        optimizer.step()
        if self._directional:
            kept = dr.opaque(mi.Float, 1 - _DIRECTION_DECAY)
            optimizer["direction"] = kept * dr.detach(optimizer["direction"])


def sides_of_levels(last: int, count: int) -> list[int]:
    """Voxels per side of so many levels: whole bricks, then twice as many each, up to ``last`` at least.

    >>> sides_of_levels(256, 3), sides_of_levels(50, 2)
    ([64, 128, 256], [28, 56])
    """
    first = BRICK * math.ceil(last / 2 ** (count - 1) / BRICK)
    return [first << level for level in range(count)]
