"""A mesh in the mean colours that images show it in, but for what all of it mirrors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...compat import mesh_scene
from ...fields.smoothing import MeshDiffusion
from ...pixels import COVERED, PixelPool
from ...template.normals import vertex_normals
from ...views import PinholeViews
from .mirrored import Mirrored, mirrored_direction

#: Batches of rays that tell the colours.
BATCHES = 40

#: Batches, of these, that tell what is mirrored: a few numbers for all of the surface.
_MIRRORED_BATCHES = 10

#: How often, in turn, colours are told what is mirrored and the other way round.
_ROUNDS = 2

#: Lambda that spreads colours along a mesh to vertices that hardly a ray comes near.
COLOR_SMOOTHING = 0.5

#: Vertices (V, 3) and faces (F, 3).
Mesh = tuple[np.ndarray, np.ndarray]

#: A triangle that no ray meets, for a mesh without any.
_NOTHING = np.zeros((3, 3)), np.array([[0, 1, 2]])


@dataclass(frozen=True)
class Look:
    """How a mesh looks to some of the views.

    Attributes:
        colors: (2 V * 3), of the front and the back of each vertex.
        mirrored: factor of these.
    """

    colors: mi.Float
    mirrored: Mirrored


@dataclass(frozen=True)
class Met:
    """What rays meet first of a mesh.

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
        return sum((weight * dr.gather(mi.Color3f, colors, vertex, self.hit)
                    for vertex, weight in zip(self.vertices, self.weights, strict=True)), mi.Color3f(0))

    def values_at(self, values: mi.Float) -> mi.Float:
        """One value per vertex, whichever its side, at the hits."""
        return sum((weight * dr.gather(mi.Float, values, vertex >> 1, self.hit)
                    for vertex, weight in zip(self.vertices, self.weights, strict=True)), mi.Float(0))

    def at(self, lane: mi.UInt32) -> Met:
        """The same on some lanes."""
        return Met([dr.gather(mi.UInt32, vertex, lane) for vertex in self.vertices],
                   [dr.gather(mi.Float, weight, lane) for weight in self.weights],
                   dr.gather(mi.Vector3f, self.mirrored, lane), dr.gather(mi.Bool, self.hit, lane))


class Shown:
    """A mesh as images show it.

    Args:
        mesh: vertices (V, 3) in world units, and faces (F, 3).
        views: the cameras.
        pools: pixels that tell the colours; each has a look of its own.
        batch: pixels per batch of rays.
        seed: of the random pixels.
        like: mirrors the same, as another part of the same surface does; default: that is found, too.

    Attributes:
        looks: one for each of the pools.
    """

    def __init__(self, mesh: Mesh, views: PinholeViews, pools: list[PixelPool], *, batch: int, seed: int,
                 like: Shown | None = None):
        vertices, faces = mesh if len(mesh[1]) else _NOTHING
        self._scene, self._corners = mesh_scene(vertices, faces), mi.UInt32(faces.astype(np.uint32).ravel())
        self._normals = vertex_normals(mi.Float(np.ascontiguousarray(vertices, np.float32).ravel()),
                                       mi.Vector3u(np.ascontiguousarray(faces.T, np.uint32)))
        self._smooth = MeshDiffusion(faces, len(vertices), COLOR_SMOOTHING)
        with dr.suspend_grad():
            self.looks = [self._look(views, pool, batch, seed, like.looks[index].mirrored if like else None)
                          for index, pool in enumerate(pools)]

    @property
    def mirrored(self) -> Mirrored:
        """What the surface mirrors, by all looks."""
        return Mirrored.mean([look.mirrored for look in self.looks])

    def look(self, ray: mi.Ray3f, index: int) -> tuple[mi.Color3f, mi.Float]:
        """Radiance and coverage along rays, in the look of that index."""
        met, look = self._met(ray), self.looks[index]
        radiance = met.interpolate(look.colors) * look.mirrored.factor(met.mirrored)
        alpha = dr.select(met.hit, mi.Float(1), 0)
        dr.eval(radiance, alpha)
        return radiance, alpha

    def _look(self, views: PinholeViews, pool: PixelPool, batch: int, seed: int,
              known: Mirrored | None) -> Look:
        seen = []
        for step in range(BATCHES):
            sample = pool.sample(batch, seed=seed, step=step)
            met = self._met(views.rays(sample.view, sample.film))
            lane = dr.compress(met.hit & (sample.alpha > COVERED))
            if not dr.width(lane):
                continue  # what is left of a surface may be too small for any ray to meet
            seen.append((met.at(lane), dr.gather(mi.Color3f, sample.radiance, lane)))
            dr.eval(seen[-1])
        mirrored = known or Mirrored.nothing()
        colors = mean_colors(seen, mirrored, self._smooth)
        for _ in range(0 if known else _ROUNDS):
            mirrored = mirrored.improved([(met.mirrored, radiance, met.interpolate(colors))
                                          for met, radiance in seen[:_MIRRORED_BATCHES]])
            colors = mean_colors(seen, mirrored, self._smooth)
        return Look(colors, mirrored)

    def _met(self, ray: mi.Ray3f) -> Met:
        found = self._scene.ray_intersect_preliminary(ray, coherent=False)
        dr.eval(found)
        hit = found.is_valid()
        back = dr.dot(found.compute_surface_interaction(ray, mi.RayFlags.Minimal, hit).n, ray.d) > 0
        uv = dr.select(hit, found.prim_uv, 0)
        weights, vertices, normal = [1 - uv.x - uv.y, uv.x, uv.y], [], mi.Vector3f(0)
        for corner, weight in enumerate(weights):
            vertex = dr.gather(mi.UInt32, self._corners, 3 * found.prim_index + corner, hit)
            normal += weight * dr.gather(mi.Vector3f, self._normals, vertex, hit)
            vertices.append(2 * vertex + dr.select(back, mi.UInt32(1), 0))
        return Met(vertices, weights, mirrored_direction(dr.normalize(ray.d), normal), hit)


def mean_colors(seen: Iterable[tuple[Met, mi.Color3f]], mirrored: Mirrored,
                smooth: MeshDiffusion) -> mi.Float:
    """(2 V * 3) mean colour of each vertex' sides.

    Args:
        seen: hits and the radiance that images show there.
        mirrored: factor of that.
        smooth: along the mesh.
    """
    sums = [dr.zeros(mi.Float, 2 * smooth.count) for _ in range(4)]
    for met, radiance in seen:
        values = (*(radiance / mirrored.factor(met.mirrored)), mi.Float(1))
        for vertex, weight in zip(met.vertices, met.weights, strict=True):
            for total, value in zip(sums, values, strict=True):
                dr.scatter_reduce(dr.ReduceOp.Add, total, weight * value, vertex, met.hit)
        dr.eval(sums)
    side = 2 * dr.arange(mi.UInt32, smooth.count)
    diffused = smooth.together({f"{back} {index}": dr.gather(mi.Float, total, side + back)
                                for back in range(2) for index, total in enumerate(sums)})
    colors = dr.zeros(mi.Float, 6 * smooth.count)
    for back in range(2):
        *color, weight = (dr.maximum(diffused[f"{back} {index}"], 0) for index in range(4))
        dr.scatter(colors, mi.Color3f(*color) / dr.maximum(weight, 1e-6), side + back)
    dr.eval(colors)
    return colors
