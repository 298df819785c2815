"""Rays through a radiance volume in bricks: what they see, and its derivatives by replay."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..bricks import Bricks, Lookup

#: Length of a step, in voxels.
_STEP = 0.5

#: Samples that count less than this have the radiance of no direction in particular: most are of that kind.
_FAINT = 0.004

#: One in so many faint samples speaks for all: adding up derivatives is what takes most time.
_SPOKEN = 4

#: Rays end where they are this dark.
_DARK = 0.003

#: Directions have no component nearer to 0.
_LEAST = 1e-7

#: Random numbers of the first steps, apart from those of the lookups.
_JITTER = 7777


@dataclass(frozen=True)
class Rays:
    """Rays in the cube [-1, 1]^3: ``origin``, unit ``direction``, ``first`` and ``last`` distance."""

    origin: mi.Point3f
    direction: mi.Vector3f
    first: mi.Float
    last: mi.Float

    @classmethod
    def through(cls, bricks: Bricks, ray: mi.Ray3f, jitter: int | None = None) -> Rays:
        """The part of rays in the cube.

        Args:
            ray: in the cube's coordinates, of any length.
            jitter: seed of random starts; None starts half a step inside.
        """
        direction = dr.normalize(ray.d)
        direction = dr.select(dr.abs(direction) < _LEAST, _LEAST, direction)
        low, high = (-1 - ray.o) / direction, (1 - ray.o) / direction
        near, far = dr.max(dr.minimum(low, high)), dr.min(dr.maximum(low, high))
        start = mi.Float(0.5)
        if jitter is not None:
            random = mi.PCG32(size=dr.width(near), initstate=dr.opaque(mi.UInt64, jitter + _JITTER))
            start = random.next_float32()
        first = dr.maximum(near, 0) + start * dr.opaque(mi.Float, _STEP * 2 / bricks.side)
        dr.eval(ray.o, direction, first, far)
        return cls(ray.o, direction, first, far)


@dataclass(frozen=True)
class Composited:
    """What rays see: ``radiance``, ``transmittance``, and of the samples' weights the sum, the sum times
    distance, and the distortion (Barron et al., CVPR 2022, eq. 15), as ``spread``."""

    radiance: mi.Color3f
    transmittance: mi.Float
    spread: mi.Vector3f


@dataclass(frozen=True)
class Adjoint:
    """What ``composite`` gave, the loss's derivatives by radiance and transmittance, and the weight of the
    distortion."""

    radiance: mi.Color3f
    transmittance: mi.Float
    spread: mi.Vector3f
    by_radiance: mi.Color3f
    by_transmittance: mi.Float
    distortion: mi.Float


def composite(
    bricks: Bricks,
    packets: mi.Float,
    rays: Rays,
    seed: int,
    *,
    adjoint: Adjoint | None = None,
    greatest: mi.Float | None = None,
) -> Composited | mi.Float:
    """Composites a volume along rays by stochastic filtering.

    Args:
        packets: per voxel 4 numbers, radiance and optical depth, or 16 with the slopes of the radiance.
        seed: of the random lookups.
        adjoint: the call replays the same rays then (Vicini et al., SIGGRAPH 2021).
        greatest: per voxel, the greatest weight in a ray; is raised.

    Returns:
        What is seen; with ``adjoint`` the derivative of the loss by ``packets``.
    """
    lookup, width = bricks.lookup(), dr.width(packets) // (4 * bricks.voxel_count)
    cell = dr.opaque(mi.Float, 2 / bricks.side)
    inverse = dr.rcp(rays.direction)
    gradient = dr.zeros(mi.Float, dr.width(packets)) if adjoint else None

    def body(t, transmittance, total, spread, before, active, random):
        position = rays.origin + t * rays.direction
        bits = random.next_uint32()  # the same ones when rays are replayed
        voxel = lookup.nearby(position, bits, active)
        here = active & (voxel >= 0)
        value = dr.gather(mi.Vector4f, packets, width * voxel, here)
        color, depth = mi.Color3f(value.x, value.y, value.z), dr.select(here, value.w, 0)
        lit = here & (transmittance * depth > _FAINT)
        for axis in range(width - 1):
            slope = dr.gather(mi.Vector4f, packets, width * voxel + (axis + 1), lit)
            color += rays.direction[axis] * mi.Color3f(slope.x, slope.y, slope.z)
        color = dr.maximum(color, 0)
        remaining = transmittance * dr.exp(-_STEP * depth)
        weight = dr.select(here, transmittance - remaining, 0)
        total += weight * color
        # Distances in lengths of the cube.
        at, length = 0.5 * t, _STEP * 0.5 * cell
        slope_of_spread = (
            2 * (at * (2 * spread.x + weight) - 2 * spread.y - weight * at) + 2 / 3 * weight * length
        )
        spread += mi.Vector3f(
            weight, weight * at, 2 * weight * (at * spread.x - spread.y) + weight * weight * length / 3
        )
        if greatest is not None:
            dr.scatter_reduce(dr.ReduceOp.Max, greatest, weight, voxel, here)
        if adjoint:
            slope_of_spread += 2 * (adjoint.spread.y - at * adjoint.spread.x)
            before += weight * slope_of_spread
            behind = (
                dr.dot(adjoint.radiance - total, adjoint.by_radiance)
                + adjoint.transmittance * adjoint.by_transmittance
                + adjoint.distortion * (2 * adjoint.spread.z - before)
            )
            by_weight = dr.dot(color, adjoint.by_radiance) + adjoint.distortion * slope_of_spread
            share = dr.select(lit, mi.Float(1), _SPOKEN)
            spoken = here & (lit | ((bits & (_SPOKEN - 1)) == 0))
            by_depth = share * _STEP * (remaining * by_weight - behind)
            by_color = share * dr.select(color > 0, weight * adjoint.by_radiance, 0)
            packet = mi.Vector4f(by_color.x, by_color.y, by_color.z, by_depth)
            dr.scatter_reduce(dr.ReduceOp.Add, gradient, packet, width * voxel, spoken)
            for axis in range(width - 1):
                along = rays.direction[axis] * by_color
                dr.scatter_reduce(
                    dr.ReduceOp.Add,
                    gradient,
                    mi.Vector4f(along.x, along.y, along.z, 0),
                    width * voxel + (axis + 1),
                    lit,
                )
        step = dr.select(
            voxel < 0, dr.maximum(lookup.way_out(position, inverse, -voxel), _STEP * cell), _STEP * cell
        )
        transmittance = dr.select(active, remaining, transmittance)
        t += step
        active &= (t < rays.last) & (transmittance > _DARK)
        return t, transmittance, total, spread, before, active, random

    count = dr.width(rays.first)
    state = (
        mi.Float(rays.first),
        dr.full(mi.Float, 1, count),
        dr.zeros(mi.Color3f, count),
        dr.zeros(mi.Vector3f, count),
        dr.zeros(mi.Float, count),
        rays.first < rays.last,
        mi.PCG32(size=count, initstate=dr.opaque(mi.UInt64, seed)),
    )
    _, transmittance, total, spread, *_ = dr.while_loop(state, lambda *values: values[5], body)
    return Composited(total, transmittance, spread) if gradient is None else gradient


def depth_along(bricks: Bricks, packets: mi.Float, rays: Rays) -> mi.Float:
    """Distance in the cube at which half of a ray's light is blocked, by exact trilinear interpolation;
    infinite where less ever is."""
    lookup, width = bricks.lookup(), dr.width(packets) // (4 * bricks.voxel_count)
    cell = dr.opaque(mi.Float, 2 / bricks.side)
    inverse = dr.rcp(rays.direction)

    def body(t, transmittance, halfway, active):
        position = rays.origin + t * rays.direction
        depth = mi.Float(0)
        for voxel, weight in lookup.around(position, active):
            optical = dr.gather(mi.Vector4f, packets, width * voxel, active & (weight > 0)).w
            depth += dr.select(weight > 0, weight * optical, 0)
        remaining = transmittance * dr.exp(-_STEP * depth)
        crosses = active & (remaining <= 0.5)
        part = dr.log(2 * transmittance) / dr.maximum(_STEP * depth, 1e-9)
        halfway = dr.select(crosses, t + (part - 0.5) * _STEP * cell, halfway)
        empty = _distance_to_brick(lookup, position, active)
        # A voxel beyond the border may still be one of the eight.
        step = dr.select(
            empty > 1, dr.maximum(lookup.way_out(position, inverse, empty - 1), _STEP * cell), _STEP * cell
        )
        t += step
        return t, remaining, halfway, active & ~crosses & (t < rays.last)

    count = dr.width(rays.first)
    state = (
        mi.Float(rays.first),
        dr.full(mi.Float, 1, count),
        dr.full(mi.Float, dr.inf, count),
        rays.first < rays.last,
    )
    return dr.while_loop(state, lambda *values: values[3], body)[2]


def _distance_to_brick(lookup: Lookup, position: mi.Point3f, active: mi.Bool) -> mi.Int32:
    place = dr.clip(mi.Point3i((position + 1) * (0.5 * mi.Float(lookup.side))), 0, lookup.side - 1)
    return -lookup.voxel(place.x, place.y, place.z, active)
