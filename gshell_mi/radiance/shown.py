"""A mesh, or parts of it, in the mean colours that images show it in, but for what all of it mirrors.

Openings are proposed by the dozen on one template, and most of what is seen is the same with and without each
of them. So where rays meet the mesh first is found once, and kept with the pixels that they are of. Of a part
of it only the rays through what is open are followed any further.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ..compat import mesh_scene
from ..fields.smoothing import MeshDiffusion
from ..pixels import COVERED, PixelPool, PixelSample
from ..template.normals import vertex_normals
from ..views import PinholeViews
from .lanes import chosen_lanes, joined_lanes
from .layers import Layer, interpolated, trace_layers
from .mirrored import Mirrored, mirrored_direction

#: Batches of rays that tell the colours, and of rays that judge.
_TELLING, JUDGING = 40, 20

#: Share of the rays that tell which tells what is mirrored: a few numbers for all of the surface.
_MIRRORED_SHARE = 0.25

#: How often, in turn, colours are told what is mirrored and the other way round.
_ROUNDS = 2

#: Lambda that spreads colours along a mesh to vertices that hardly a ray comes near.
_SMOOTHING = 0.5

#: Layers of the mesh that a ray may pass.
_LAYERS = 8

#: Vertices (V, 3) and faces (F, 3).
Mesh = tuple[np.ndarray, np.ndarray]

#: A triangle that no ray meets, for a mesh without any.
_NOTHING = np.zeros((3, 3)), np.array([[0, 1, 2]])


@dataclass(frozen=True)
class Met:
    """Where rays meet a mesh.

    Attributes:
        vertices: three of each hit; even numbers from the front, odd ones from the back.
        weights: barycentric.
        mirrored: unit directions into which the rays are mirrored.
        hit: whether anything is met.
    """

    vertices: list[mi.UInt32]
    weights: list[mi.Float]
    mirrored: mi.Vector3f
    hit: mi.Bool

    @classmethod
    def nothing(cls) -> Met:
        """One ray that meets nothing."""
        return cls([mi.UInt32(0)] * 3, [mi.Float(0)] * 3, mi.Vector3f(0, 0, 1), mi.Bool(False))

    def interpolate(self, colors: mi.Float) -> mi.Color3f:
        """Colours of the sides of vertices at the hits."""
        return interpolated(mi.Color3f, colors, self.vertices, self.weights, self.hit)

    def values_at(self, values: mi.Float) -> mi.Float:
        """One value per vertex, whichever its side, at the hits."""
        vertices = [side >> 1 for side in self.vertices]
        return interpolated(mi.Float, values, vertices, self.weights, self.hit)

    def at(self, lane: mi.UInt32) -> Met:
        """The same on some lanes."""
        return Met(
            [dr.gather(mi.UInt32, vertex, lane) for vertex in self.vertices],
            [dr.gather(mi.Float, weight, lane) for weight in self.weights],
            dr.gather(mi.Vector3f, self.mirrored, lane),
            dr.gather(mi.Bool, self.hit, lane),
        )


@dataclass(frozen=True)
class FirstHits:
    """Rays that meet a mesh, one lane each.

    Attributes:
        pixel: that a ray goes through.
        met: where it meets the mesh first.
    """

    pixel: PixelSample
    met: Met

    def at(self, lane: mi.UInt32) -> FirstHits:
        """The same on some lanes."""
        return FirstHits(self.pixel.at(lane), self.met.at(lane))


class Shown:
    """A mesh as images show it.

    Args:
        mesh: vertices (V, 3) in world units, and faces (F, 3).
        views: the cameras.
        pools: for each split of the views, the pixels that tell the colours, and those that judge.
        batch: pixels per batch of rays.
        seed: of the random pixels.
        like: mirrors the same, as another part of the same surface does; default: that is found, too.
    """

    def __init__(
        self,
        mesh: Mesh,
        views: PinholeViews,
        pools: list[tuple[PixelPool, PixelPool]],
        *,
        batch: int,
        seed: int,
        like: Shown | None = None,
    ):
        self.mesh, self.views, self._pools, self._like = mesh, views, pools, like
        self._batch, self._seed = batch, seed
        vertices, faces = mesh if len(mesh[1]) else _NOTHING
        self._scene = mesh_scene(vertices, faces)
        self._positions = mi.Float(np.ascontiguousarray(vertices, np.float32).ravel())
        self._faces = mi.Vector3u(np.ascontiguousarray(faces.T, np.uint32))
        self._normals = vertex_normals(self._positions, self._faces)
        self._offset = 1e-4 * float(np.ptp(vertices, axis=0).max())

    @cached_property
    def _smooth(self) -> MeshDiffusion:
        """Along the mesh. Who is only asked where rays meet it needs none."""
        faces = self._faces.numpy().T
        return MeshDiffusion(faces, dr.width(self._positions) // 3, _SMOOTHING)

    @cached_property
    def edge(self) -> float:
        """Mean length of an edge, world units."""
        corners = self._positions.numpy().reshape(-1, 3)[self._faces.numpy().T]
        return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).mean())

    @cached_property
    def middle(self) -> np.ndarray:
        """(3,) mean of the vertices, world units."""
        return self._positions.numpy().reshape(-1, 3).mean(axis=0)

    @property
    def mirrored(self) -> Mirrored:
        """What the surface mirrors, by all splits."""
        return Mirrored.mean(self.mirrors)

    @property
    def mirrors(self) -> list[Mirrored]:
        """What it mirrors, by each split."""
        return self._like.mirrors if self._like else self._first_look[0]

    @property
    def whole(self) -> Part:
        """All of it."""
        return Part(self, None, self._first_look[1])

    @cached_property
    def _first_look(self) -> tuple[list[Mirrored], list[mi.Float]]:
        """What it mirrors, and the colours of all of it. Of most meshes no more is asked: no ray is kept."""
        with dr.suspend_grad():
            telling = self.__dict__.get("_telling") or self._told()
            mirrors = self._like.mirrors if self._like else [self._mirrored_by(rays) for rays in telling]
            return mirrors, [
                self._mean_colors([(rays.met, rays.pixel.radiance)], mirrored)
                for rays, mirrored in zip(telling, mirrors, strict=True)
            ]

    @cached_property
    def judging(self) -> list[FirstHits]:
        """The rays that judge and meet it, for each split."""
        return [self._first_hits(pool, JUDGING) for _, pool in self._pools]

    def part(self, values: np.ndarray) -> Part:
        """What the interpolated values (V,) are positive on."""
        field = mi.Float(np.ascontiguousarray(values, np.float32))
        with dr.suspend_grad():
            return Part(
                self,
                field,
                [
                    self._mean_colors(
                        [
                            (met, dr.gather(mi.Color3f, rays.pixel.radiance, lane))
                            for lane, met in self.hits(rays.pixel, field, rays.met)
                        ],
                        mirrored,
                    )
                    for rays, mirrored in zip(self._telling, self.mirrors, strict=True)
                ],
            )

    def hits(
        self, pixel: PixelSample, values: mi.Float | None, first: Met | None = None
    ) -> Iterator[tuple[mi.UInt32, Met]]:
        """Where the rays of pixels meet a part; their lanes, each once or not at all.

        Args:
            pixel: of the rays.
            values: (V,) as of ``part``; None is the whole mesh.
            first: where they meet the mesh first, if that is known.
        """
        lane = dr.arange(mi.UInt32, dr.width(pixel.view))
        if first:
            solid = first.hit & (first.values_at(values) > 0) if values is not None else first.hit
            yield lane, replace(first, hit=solid)
            if values is None:
                return
            lane = chosen_lanes(~solid, solid)
        for layer in self._layers(pixel.at(lane) if first else pixel, values):
            lane = dr.gather(mi.UInt32, lane, layer.lane)
            met = self._met(layer, dr.gather(mi.UInt32, pixel.view, lane))
            yield lane, replace(met, hit=met.values_at(values) > 0) if values is not None else met

    @cached_property
    def _telling(self) -> list[FirstHits]:
        """As of ``_told``, kept: the parts of a template are many."""
        return self._told()

    def _told(self) -> list[FirstHits]:
        """The rays that tell the colours, for each split."""
        return [self._first_hits(pool, _TELLING, covered=True) for pool, _ in self._pools]

    def _mirrored_by(self, rays: FirstHits) -> Mirrored:
        """What some rays say that the surface mirrors."""
        mirrored = Mirrored.nothing()
        count = max(int(_MIRRORED_SHARE * dr.width(rays.pixel.view)), 1)
        some = rays.at(dr.arange(mi.UInt32, count))
        for _ in range(_ROUNDS):
            colors = self._mean_colors([(rays.met, rays.pixel.radiance)], mirrored)
            mirrored = mirrored.improved(
                some.met.mirrored, some.pixel.radiance, some.met.interpolate(colors), some.pixel.view
            )
        return mirrored

    def _first_hits(self, pixels: PixelPool, batches: int, *, covered: bool = False) -> FirstHits:
        """Rays of random pixels, or of those that are covered; but for those that meet nothing."""
        found = []
        for step in range(batches):
            sample = pixels.sample(self._batch, seed=self._seed, step=step)
            if covered:
                sample = sample.at(chosen_lanes(sample.alpha > COVERED, sample))
            for layer in self._layers(sample, None):
                pixel = sample.at(layer.lane)
                found.append(FirstHits(pixel, self._met(layer, pixel.view)))
                dr.eval(found[-1])
        # Arrays are never empty: a pixel whose ray meets nothing.
        return joined_lanes(found) if found else FirstHits(pixels.sample(1, seed=0, step=0), Met.nothing())

    def _mean_colors(self, seen: list[tuple[Met, mi.Color3f]], mirrored: Mirrored) -> mi.Float:
        """(2 V * 3) mean colour of each vertex' sides, of hits and the radiance that images show there."""
        count = self._smooth.count
        sums = [dr.zeros(mi.Float, 2 * count) for _ in range(4)]
        for met, radiance in seen:
            values = (*(radiance / mirrored.factor(met.mirrored)), mi.Float(1))
            for vertex, weight in zip(met.vertices, met.weights, strict=True):
                for total, value in zip(sums, values, strict=True):
                    dr.scatter_reduce(dr.ReduceOp.Add, total, weight * value, vertex, met.hit)
            dr.eval(sums)
        side = 2 * dr.arange(mi.UInt32, count)
        diffused = self._smooth.together(
            {
                f"{back} {channel}": dr.gather(mi.Float, total, side + back)
                for back in range(2)
                for channel, total in enumerate(sums)
            }
        )
        colors = dr.zeros(mi.Float, 6 * count)
        for back in range(2):
            *color, weight = (dr.maximum(diffused[f"{back} {channel}"], 0) for channel in range(4))
            dr.scatter(colors, mi.Color3f(*color) / dr.maximum(weight, 1e-6), side + back)
        dr.eval(colors)
        return colors

    def _layers(self, pixel: PixelSample, values: mi.Float | None) -> list[Layer]:
        """What rays meet up to a part, or of the whole mesh."""
        if not dr.width(pixel.view):
            return []
        ray = self.views.rays(pixel.view, pixel.film)
        if values is None:
            return trace_layers(self._scene, self._positions, self._faces, ray, 1, self._offset)
        return trace_layers(
            self._scene,
            self._positions,
            self._faces,
            ray,
            _LAYERS,
            self._offset,
            lambda layer: layer.interpolate(values) <= 0,
        )

    def _met(self, layer: Layer, view: mi.UInt32) -> Met:
        """Where rays of some views meet a layer."""
        normal = interpolated(mi.Vector3f, self._normals, layer.face, layer.weights)
        return Met(
            [layer.side(corner) for corner in layer.face],
            list(layer.weights),
            self.views.in_surroundings(view, mirrored_direction(dr.normalize(layer.direction), normal)),
            dr.full(mi.Bool, True, dr.width(layer.lane)),
        )


@dataclass(frozen=True)
class Part:
    """A part of a mesh as images show it.

    Attributes:
        shown: all of the mesh.
        values: (V,) positive on the part; None is all of it.
        colors: for each split of the views, (2 V * 3) of the front and the back of each vertex.
    """

    shown: Shown
    values: mi.Float | None
    colors: list[mi.Float]

    def look(self, pixel: PixelSample, split: int, first: Met | None = None) -> tuple[mi.Color3f, mi.Float]:
        """Radiance and coverage of pixels.

        Args:
            pixel: which.
            split: whose colours are seen.
            first: where their rays meet the whole mesh first, if that is known.
        """
        count = dr.width(pixel.view)
        radiance, alpha = dr.zeros(mi.Color3f, count), dr.zeros(mi.Float, count)
        mirrored = self.shown.mirrors[split]
        for lane, met in self.shown.hits(pixel, self.values, first):
            color = met.interpolate(self.colors[split]) * mirrored.factor(met.mirrored)
            dr.scatter(radiance, color, lane, met.hit)
            dr.scatter(alpha, mi.Float(1), lane, met.hit)
        dr.eval(radiance, alpha)
        return radiance, alpha
