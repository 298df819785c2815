"""Draws points on edges together with light for which the edge is a silhouette.

For the environment each sample has a direction of its own, drawn from the edge's lunes (see
``edge_wedges``) with a density proportional to the apparent length of the
edge; where an environment map is bright beyond what that density can serve, directions of its own
density take over. Light from points is drawn first, 32 points per emitter, and edges then in
proportion to what they cut off.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi

from ..arrays import AnyArray
from .edge_wedges import EdgeWedges, silhouette_for
from .resampling import expand, low_discrepancy, systematic_counts

BATCH = 32

#: Directions from which an environment map sends more than this times its mean density are drawn
#: from the map.
_PEAK = 8.0


@dataclass
class ShadowSamples:
    """Points on edges and light that the edges may cut off."""

    edge: mi.UInt32  #: index into the ``EdgeWedges``
    t: mi.Float  #: where on the edge
    weight: mi.Float  #: one over the expected number of such samples
    position: mi.Vector3f  #: unit direction of the light, or point on an emitter
    normal: mi.Normal3f | None  #: the emitter's there, if it has any
    uv: mi.Point2f | None  #: its texture coordinates there
    kind: mi.Float  #: uniform random number
    via: mi.Point2f  #: uniform random numbers
    emitter: mi.Emitter | None = None  #: the emitter; ``None`` for the environment
    is_point: bool = False  #: whether ``position`` is a point

    def take(self, index: mi.UInt32) -> ShadowSamples:
        """The samples with the given indices."""
        arrays = [None if x is None else dr.gather(type(x), x, index) for x in self.arrays()]
        return ShadowSamples(*arrays, emitter=self.emitter, is_point=self.is_point)

    def arrays(self) -> list[AnyArray | None]:
        """What there is one of per sample."""
        return [getattr(self, f.name) for f in fields(self)[:-2]]

    def towards(self, y: mi.Point3f) -> mi.Vector3f:
        """Unit direction of the light from points, attached to them."""
        return dr.normalize(mi.Point3f(self.position) - y) if self.is_point else self.position


def draw_directions(
    scene: mi.Scene, wedges: EdgeWedges, samples: int, shifts: mi.Float
) -> ShadowSamples | None:
    """Edges by length and width of their lunes, directions from the lunes.

    Half of the samples are spread evenly over the meshes, lest the rim of a large floor gets all.
    """
    p, q, *_ = wedges.frame(dr.arange(mi.UInt32, dr.width(wedges.start)))
    mass = dr.norm(q - p) * wedges.opening()
    importance = mass / dr.sum(mass) + mass / (wedges.mesh_mass * wedges.meshes)
    drawn = systematic_counts(importance, samples, dr.gather(mi.Float, shifts, 7))
    if drawn is None:
        return None
    count, weight = drawn
    edge, _, _ = expand(count)
    index = dr.arange(mi.UInt32, dr.width(edge))
    u = [low_discrepancy(index, k, shifts) for k in range(7)]
    weight = dr.gather(mi.Float, weight, edge)

    _, _, axis, inward, across = wedges.frame(edge)
    low, high = dr.gather(mi.Float, wedges.low, edge), dr.gather(mi.Float, wedges.high, edge)
    opening = dr.pi - (high - low)
    # The cosine to the axis has a semicircular density, so directions have one of sin / (pi opening).
    cosine = dr.sqrt(u[1]) * dr.cos(2 * dr.pi * u[2])
    sine = dr.sqrt(dr.maximum(1 - dr.square(cosine), 0))
    twice = 2 * u[3]
    angle = high + opening * (twice - dr.floor(twice)) + dr.select(twice >= 1, dr.pi, 0)
    direction = axis * cosine + (inward * dr.cos(angle) + across * dr.sin(angle)) * sine
    weight *= dr.select(sine > 1e-4, dr.pi * opening / sine, 0)
    result = ShadowSamples(
        edge,
        u[0],
        weight * (1 - _map_share(scene, direction)),
        direction,
        None,
        None,
        u[4],
        mi.Point2f(u[5], u[6]),
    )
    dr.eval(result.arrays())
    return result


def _map_share(scene: mi.Scene, direction: mi.Vector3f) -> mi.Float:
    """Which share of the light from a direction is left to ``draw_map_directions``."""
    if scene.environment() is None:
        return mi.Float(0)
    ds = dr.zeros(mi.DirectionSample3f, dr.width(direction))
    ds.d = direction
    density = scene.environment().pdf_direction(dr.zeros(mi.Interaction3f, dr.width(direction)), ds)
    return dr.maximum(1 - _PEAK / (4 * dr.pi * density), 0)


def _points(shifts: mi.Float) -> mi.Point2f:
    """32 points in the unit square, evenly spread."""
    index = dr.arange(mi.UInt32, BATCH)
    return mi.Point2f(low_discrepancy(index, 0, shifts), low_discrepancy(index, 1, shifts))


def draw_map_directions(
    scene: mi.Scene, wedges: EdgeWedges, samples: int, shifts: mi.Float
) -> ShadowSamples | None:
    """Directions from an environment map's own density, where it is much brighter than elsewhere."""
    environment = scene.environment()
    if environment is None:
        return None
    it = dr.zeros(mi.Interaction3f, BATCH)
    it.p = mi.Point3f(scene.bbox().center())
    ds, _ = environment.sample_direction(it, _points(shifts))
    share = _map_share(scene, ds.d)
    if not dr.any(share > 0)[0]:
        return None
    return _draw_batch(wedges, mi.Vector3f(ds.d), share / (BATCH * ds.pdf), samples, shifts)


def draw_emitters(
    scene: mi.Scene, wedges: EdgeWedges, samples: int, shifts: mi.Float
) -> Iterator[ShadowSamples | None]:
    """For each other light points on it (or its direction), and edges that are silhouettes for them."""
    nowhere = dr.zeros(mi.Interaction3f, BATCH)
    for shape in scene.shapes():
        if shape.emitter() is not None:
            ps = shape.sample_position(0.0, _points(shifts))
            yield _draw_batch(
                wedges,
                mi.Vector3f(ps.p),
                dr.rcp(BATCH * ps.pdf),
                samples,
                shifts,
                shape.emitter(),
                True,
                ps.n,
                ps.uv,
            )
    for emitter in scene.emitters():
        is_point = mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition)
        if is_point or mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection):
            ds, _ = emitter.sample_direction(nowhere, _points(shifts))
            yield _draw_batch(
                wedges,
                mi.Vector3f(ds.p if is_point else ds.d),
                mi.Float(1 / BATCH),
                samples,
                shifts,
                emitter,
                is_point,
            )


def _draw_batch(
    wedges: EdgeWedges,
    position: mi.Vector3f,
    weight: mi.Float,
    samples: int,
    shifts: mi.Float,
    emitter: mi.Emitter | None = None,
    is_point: bool = False,
    normal: mi.Normal3f | None = None,
    uv: mi.Point2f | None = None,
) -> ShadowSamples | None:
    position, weight = (x + dr.zeros(type(x), BATCH) for x in (position, weight))
    dr.make_opaque(position, weight, normal, uv)
    edge = dr.arange(mi.UInt32, dr.width(wedges.start))
    p, q, _, inward, across = wedges.frame(edge)
    flat = dr.ravel(position)
    dr.eval(flat)

    def direction(source: mi.UInt32) -> mi.Vector3f:
        z = dr.gather(mi.Vector3f, flat, source)
        return mi.Vector3f(mi.Point3f(z) - 0.5 * (p + q)) if is_point else z

    bits = mi.UInt32(0)
    for j in range(BATCH):
        is_silhouette = silhouette_for(direction(mi.UInt32(j)), inward, across, wedges.low, wedges.high)
        bits |= dr.select(is_silhouette, mi.UInt32(1 << j), 0)
    edge, number, total = expand(dr.popcnt(bits))
    if total == 0:
        return None
    word = dr.gather(mi.UInt32, bits, edge)  # find its number-th set bit
    source = mi.UInt32(0)
    for j in range(BATCH):
        is_set = (word >> j) & 1
        source = dr.select((is_set == 1) & (number == 0), j, source)
        number = dr.select(is_set == 1, number - 1, number)
    dr.eval(source)
    p, q, axis, *_ = wedges.frame(edge)
    d = direction(source)
    falloff = dr.rcp(dr.maximum(dr.squared_norm(d), 1e-12)) if is_point else 1
    if normal is not None:
        falloff *= dr.maximum(dr.dot(dr.gather(mi.Normal3f, normal, source), -dr.normalize(d)), 0)
    apparent = dr.norm(q - p) * dr.norm(dr.cross(axis, dr.normalize(d)))
    of_source = dr.gather(mi.Float, weight, source)
    drawn = systematic_counts(apparent * of_source * falloff, samples, dr.gather(mi.Float, shifts, 7))
    if drawn is None:
        return None
    count, one_over_expected = drawn
    chosen, _, _ = expand(count)
    index = dr.arange(mi.UInt32, dr.width(chosen))
    source = dr.gather(mi.UInt32, source, chosen)
    result = ShadowSamples(
        dr.gather(mi.UInt32, edge, chosen),
        low_discrepancy(index, 2, shifts),
        dr.gather(mi.Float, of_source * one_over_expected, chosen),
        dr.gather(mi.Vector3f, flat, source),
        None if normal is None else dr.gather(mi.Normal3f, normal, source),
        None if uv is None else dr.gather(mi.Point2f, uv, source),
        low_discrepancy(index, 4, shifts),
        mi.Point2f(low_discrepancy(index, 5, shifts), low_discrepancy(index, 6, shifts)),
        emitter,
        is_point,
    )
    dr.eval(result.arrays())
    return result
