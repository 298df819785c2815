"""Parts of one template as images show them: where rays meet it is found once for all of them.

Openings are proposed by the dozen, and most of what is seen is the same with and without each of them. So the
first hits on the closed template are kept, with the pixels that they are of. Of a part of it only the rays
through what is open are followed any further.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ...compat import mesh_scene
from ...fields.smoothing import MeshDiffusion
from ...pixels import COVERED, PixelPool, PixelSample
from ...template.normals import vertex_normals
from ...views import PinholeViews
from .lanes import chosen_lanes, joined_lanes
from .layers import Sheet, trace_layers
from .mirrored import Mirrored, mirrored_direction
from .shown import BATCHES, COLOR_SMOOTHING, Mesh, Met, mean_colors

#: Sheets of the template that a ray may pass.
_SHEETS = 8


@dataclass(frozen=True)
class FirstHits:
    """Rays that meet a template, one lane each.

    Attributes:
        pixel: that a ray goes through.
        met: where it meets the template first.
    """

    pixel: PixelSample
    met: Met

    def at(self, lane: mi.UInt32) -> FirstHits:
        """The same on some lanes."""
        return FirstHits(self.pixel.at(lane), self.met.at(lane))


class TracedMesh:
    """A closed mesh in front of cameras.

    Args:
        mesh: vertices (V, 3) in world units, and faces (F, 3), oriented outwards.
        views: the cameras.
    """

    def __init__(self, mesh: Mesh, views: PinholeViews):
        vertices, faces = mesh
        self.mesh, self.views = mesh, views
        self._scene = mesh_scene(vertices, faces)
        self._positions = mi.Float(np.ascontiguousarray(vertices, np.float32).ravel())
        self._faces = mi.Vector3u(np.ascontiguousarray(faces.T, np.uint32))
        self._normals = vertex_normals(self._positions, self._faces)
        self._offset = 1e-4 * float(np.ptp(vertices, axis=0).max())
        self.smooth = MeshDiffusion(faces, len(vertices), COLOR_SMOOTHING)

    def first_hits(self, pixels: PixelPool, batches: int, batch: int, seed: int, *,
                   covered: bool = False) -> FirstHits:
        """Rays of random pixels, or of those that are covered; but for those that meet nothing."""
        found = []
        for step in range(batches):
            sample = pixels.sample(batch, seed=seed, step=step)
            if covered:
                sample = sample.at(chosen_lanes(sample.alpha > COVERED, sample))
            for sheet in self._sheets(sample, 1):
                found.append(FirstHits(sample.at(sheet.lane), self._met(sheet)))
                dr.eval(found[-1])
        # Arrays are never empty: a pixel whose ray meets nothing.
        return joined_lanes(found) if found else FirstHits(pixels.sample(1, seed=seed, step=0), Met.nothing())

    def hits(self, rays: FirstHits, values: mi.Float) -> Iterator[tuple[mi.UInt32, Met]]:
        """Where rays meet what ``values`` (V,) are positive on; their lanes, each once or not at all."""
        solid = rays.met.values_at(values) > 0
        yield dr.arange(mi.UInt32, dr.width(solid)), replace(rays.met, hit=solid)
        lane = chosen_lanes(~solid, solid)
        for sheet in self._sheets(rays.pixel.at(lane), _SHEETS,
                                  lambda sheet: sheet.interpolate(values) <= 0):
            lane = dr.gather(mi.UInt32, lane, sheet.lane)
            yield lane, replace(self._met(sheet), hit=sheet.interpolate(values) > 0)

    def _sheets(self, sample: PixelSample, count: int,
                goes_on: Callable[[Sheet], mi.Bool] | None = None) -> list[Sheet]:
        if not dr.width(sample.view):
            return []
        return trace_layers(self._scene, self._positions, self._faces,
                            self.views.rays(sample.view, sample.film), count, self._offset, goes_on)

    def _met(self, sheet: Sheet) -> Met:
        normal = sum((weight * dr.gather(mi.Vector3f, self._normals, corner)
                      for weight, corner in zip(sheet.weights, sheet.face, strict=True)), mi.Vector3f(0))
        return Met([sheet.side(corner) for corner in sheet.face], list(sheet.weights),
                   mirrored_direction(dr.normalize(sheet.direction), normal),
                   dr.full(mi.Bool, True, dr.width(sheet.lane)))


class Parts:
    """What images tell of parts of a template.

    Args:
        template: all of it.
        told: for each split of the views, the pixels that tell the colours, and those that judge.
        mirrored: by all of it; one for each split.
        batch, judged: pixels per batch of rays, and batches that judge.
        seed: of the random pixels.
    """

    def __init__(self, template: TracedMesh, told: list[tuple[PixelPool, PixelPool]],
                 mirrored: list[Mirrored], *, batch: int, judged: int, seed: int):
        self.template, self.mirrored = template, mirrored
        with dr.suspend_grad():
            self._telling = [template.first_hits(known, BATCHES, batch, seed, covered=True)
                             for known, _ in told]
            #: Rays that judge, for each split.
            self.judging = [template.first_hits(unknown, judged, batch, seed) for _, unknown in told]

    @property
    def faces(self) -> np.ndarray:
        """(F, 3) of the template."""
        return self.template.mesh[1]

    def of(self, values: np.ndarray) -> Part:
        """What the interpolated values (V,) are positive on."""
        field = mi.Float(np.ascontiguousarray(values, np.float32))
        with dr.suspend_grad():
            return Part(self, field, [self._colors(split, field) for split in range(len(self.mirrored))])

    @cached_property
    def all(self) -> Part:
        """The whole template."""
        return self.of(np.ones(len(self.template.mesh[0])))

    def _colors(self, split: int, values: mi.Float) -> mi.Float:
        rays, mirrored = self._telling[split], self.mirrored[split]
        seen = ((met, dr.gather(mi.Color3f, rays.pixel.radiance, lane))
                for lane, met in self.template.hits(rays, values))
        return mean_colors(seen, mirrored, self.template.smooth)


@dataclass(frozen=True)
class Part:
    """A part of a template.

    Attributes:
        parts: of the same template.
        values: (V,) positive on it.
        colors: for each split of the views, (2 V * 3) of the front and the back of each vertex.
    """

    parts: Parts
    values: mi.Float
    colors: list[mi.Float]

    def look(self, rays: FirstHits, split: int) -> tuple[mi.Color3f, mi.Float]:
        """Radiance and coverage along rays."""
        count = dr.width(rays.pixel.view)
        radiance, alpha = dr.zeros(mi.Color3f, count), dr.zeros(mi.Float, count)
        with dr.suspend_grad():
            for lane, met in self.parts.template.hits(rays, self.values):
                color = met.interpolate(self.colors[split]) * self.parts.mirrored[split].factor(met.mirrored)
                dr.scatter(radiance, color, lane, met.hit)
                dr.scatter(alpha, mi.Float(1), lane, met.hit)
            dr.eval(radiance, alpha)
        return radiance, alpha

    @cached_property
    def looks(self) -> list[tuple[mi.Color3f, mi.Float]]:
        """Along all rays that judge, for each split: one part is often compared with many."""
        return [self.look(rays, split) for split, rays in enumerate(self.parts.judging)]
