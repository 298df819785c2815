"""The derivative of what the first visible surface receives, where edges cut it off.

For a fixed direction ``ω`` (or a fixed point ``z`` of an area light) the reflected light
``F(u) = f(x(u), ω) L(x(u), ω)`` is a function on the film. It jumps along the curve on which the
silhouette edges for ``ω`` cast their shadow on what the camera sees. By Reynolds' theorem those
curves add

    sum over edges, integral over t of  h(c) (F_- - F_+) cross(dc/dt, dc/dθ)

to the derivative of a pixel with filter ``h``, where ``c(t, θ)`` is the film position of the shadow
of the edge point ``t``. Writing the boundary term on the film needs no further Jacobians: ``c`` is
an edge point, projected along ``ω`` on the receiver and from there on the film, all attached.

A batch of 32 directions or points shares the search for silhouette edges: which side each lies on is
one bit per face, and an edge carries the silhouette where the bits of its faces agree.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .edge_table import SIZE_INDEPENDENT
from .silhouette_edges import project_to_film

BATCH = 32


@dataclass
class LightSources:
    """A batch of 32 sampled directions, or points on emitters."""

    position: object    #: ``Vector3f``, 32: unit direction, or point in world space
    is_point: bool      #: which of the two
    weight: object      #: ``Float``, 32: one over the number of samples and their density
    importance: object  #: ``Float``, 32: how densely to sample edges, relative to each other
    emitter: object = None  #: the emitter that all points lie on
    normal: object = None   #: ``Normal3f``, 32: its normal, for area lights
    uv: object = None       #: ``Point2f``, 32: its texture coordinates there


def _batch(x):
    """Every source its own entry, even where all are equal, for gathers."""
    x = x + dr.zeros(type(x), BATCH)
    dr.make_opaque(x)
    return x


def sample_directions(scene, sampler):
    """Half of the directions from the environment's density, half uniform over the sphere."""
    it = dr.zeros(mi.Interaction3f, BATCH)
    box = scene.bbox()
    it.p = mi.Point3f(box.center()) if box.valid() else mi.Point3f(0)
    sample = sampler.next_2d()
    environment = scene.environment()
    index = dr.arange(mi.UInt32, BATCH)
    strata = BATCH if environment is None else BATCH // 2
    uniform = mi.warp.square_to_uniform_sphere(
        mi.Point2f((mi.Float(index % strata) + sample.x) / strata, sample.y))
    if environment is None:
        return LightSources(_batch(mi.Vector3f(uniform)), False, _batch(mi.Float(4 * dr.pi / BATCH)),
                            _batch(mi.Float(1)))
    ds, _ = environment.sample_direction(it, sampler.next_2d())
    direction = dr.select(index < strata, ds.d, uniform)
    ds.d = direction
    density = 0.5 * environment.pdf_direction(it, ds) + 0.5 / (4 * dr.pi)
    si = dr.zeros(mi.SurfaceInteraction3f, BATCH)
    si.wi = -direction
    radiance = dr.mean(mi.unpolarized_spectrum(environment.eval(si)))
    weight = 1 / (BATCH * density)
    radiance = dr.maximum(radiance, 0.1 * dr.mean(radiance * weight) / (4 * dr.pi) * BATCH)
    return LightSources(_batch(direction), False, _batch(weight), _batch(radiance * weight))


def sample_points(scene, sampler):
    """For each area, point and spot light a batch of points on it."""
    for shape in scene.shapes():
        if shape.emitter() is not None:
            ps = shape.sample_position(0.0, sampler.next_2d())
            yield LightSources(_batch(mi.Vector3f(ps.p)), True, _batch(dr.rcp(BATCH * ps.pdf)),
                               _batch(mi.Float(1)), shape.emitter(), _batch(ps.n), _batch(ps.uv))
    for emitter in scene.emitters():
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
            ds, _ = emitter.sample_direction(dr.zeros(mi.Interaction3f, BATCH), sampler.next_2d())
            yield LightSources(_batch(mi.Vector3f(ds.p)), True, _batch(mi.Float(1 / BATCH)),
                               _batch(mi.Float(1)), emitter)


def light_from_point(scene, si, sources, index, active):
    """Light that arrives at surface points from points of a batch: direction and value."""
    z = mi.Point3f(dr.gather(mi.Vector3f, dr.ravel(sources.position), index))
    ds = dr.zeros(mi.DirectionSample3f, dr.width(index))
    offset = z - si.p
    ds.p, ds.dist = z, dr.norm(offset)
    ds.d = offset / ds.dist
    ds.emitter = mi.EmitterPtr(sources.emitter)
    geometry = mi.Float(1)
    if sources.normal is not None:
        ds.n = dr.gather(mi.Normal3f, dr.ravel(sources.normal), index)
        ds.uv = dr.gather(mi.Point2f, dr.ravel(sources.uv), index)
        geometry = dr.abs_dot(ds.n, ds.d) / dr.square(ds.dist)
    active = active & ~scene.ray_test(si.spawn_ray_to(z), active)
    return ds.d, dr.select(active, sources.emitter.eval_direction(si, ds, active) * geometry, 0)


def _silhouette_bits(mesh, table, sources):
    """Per directed edge, for which sources it carries the silhouette, one bit each."""
    positions, faces = dr.detach(mesh.vertex_positions_buffer()), mesh.faces_buffer()
    n = dr.width(faces) // 3
    face = dr.arange(mi.UInt32, n)
    p0, p1, p2 = (dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, faces, 3 * face + k))
                  for k in range(3))
    normal = dr.cross(p1 - p0, p2 - p0)
    flat = dr.ravel(sources.position)
    dr.eval(flat)
    bits = mi.UInt32(0)
    for j in range(BATCH):
        z = dr.gather(mi.Vector3f, flat, mi.UInt32(j))
        height = dr.dot(normal, z - p0 if sources.is_point else z)
        bits |= dr.select(height > 0, mi.UInt32(1 << j), 0)
    dr.eval(bits)
    side = dr.gather(mi.UInt32, bits, dr.arange(mi.UInt32, 3 * n) // 3)
    side = dr.select(table.forward, side, ~side)
    everywhere = dr.full(mi.UInt32, 0xFFFFFFFF, 3 * n)
    above, below = everywhere, dr.full(mi.UInt32, 0xFFFFFFFF, 3 * n)
    dr.scatter_reduce(dr.ReduceOp.And, above, side, table.edge, table.valid,
                      mode=SIZE_INDEPENDENT)
    dr.scatter_reduce(dr.ReduceOp.And, below, ~side, table.edge, table.valid,
                      mode=SIZE_INDEPENDENT)
    return dr.select(table.degree > 0, above | below, 0)


def _expand(count):
    """For counts per item, the item of each of the ``sum(count)`` entries and its number there."""
    item = dr.compress(count > 0)
    if dr.width(item) == 0:
        return item, item, 0
    count = dr.gather(mi.UInt32, count, item)
    first = dr.prefix_sum(count)
    total = dr.sum(count)[0]
    mark = dr.zeros(mi.UInt32, total)
    dr.scatter(mark, mi.UInt32(1), first, mode=dr.ReduceMode.Permute)
    run = dr.cumsum(mark) - 1
    entry = dr.gather(mi.UInt32, item, run)
    number = dr.arange(mi.UInt32, total) - dr.gather(mi.UInt32, first, run)
    dr.eval(entry, number)
    return entry, number, total


def _sample_edges(mesh, table, sources, samples, sampler):
    """Silhouette edges of a mesh, drawn in proportion to their apparent length and importance.

    Returns end point indices, source index and weight of each sample, or ``None``.
    """
    bits = _silhouette_bits(mesh, table, sources)
    edge, number, total = _expand(dr.popcnt(bits))
    if total == 0:
        return None
    # The number-th set bit
    word = dr.gather(mi.UInt32, bits, edge)
    source = mi.UInt32(0)
    for j in range(BATCH):
        is_set = (word >> j) & 1
        source = dr.select((is_set == 1) & (number == 0), j, source)
        number = dr.select(is_set == 1, number - 1, number)
    dr.eval(source)
    start, end = dr.gather(mi.UInt32, table.start, edge), dr.gather(mi.UInt32, table.end, edge)
    positions = dr.detach(mesh.vertex_positions_buffer())
    p, q = dr.gather(mi.Point3f, positions, start), dr.gather(mi.Point3f, positions, end)
    towards = dr.gather(mi.Vector3f, dr.ravel(sources.position), source)
    if sources.is_point:
        towards = dr.normalize(towards - 0.5 * (p + q))
    importance = dr.norm(dr.cross(q - p, towards)) * dr.gather(mi.Float, sources.importance, source)
    importance = dr.select(dr.isfinite(importance), importance, 0)

    # Systematic resampling: one uniform number for all samples
    cumulative = dr.cumsum(mi.Float64(importance))
    dr.eval(start, end, source, importance, cumulative)
    mass = dr.gather(mi.Float64, cumulative, dr.opaque(mi.UInt32, dr.width(cumulative) - 1))
    offset = mi.Float64(sampler.next_1d()[0])
    scaled = dr.minimum(cumulative / mass, 1) * samples + dr.opaque(mi.Float64, offset[0])
    upper = mi.UInt32(dr.floor(scaled))
    index = dr.arange(mi.UInt32, dr.width(upper))
    lower = dr.gather(mi.UInt32, upper, index - 1, index > 0)
    dr.eval(upper)
    chosen, _, total = _expand(upper - lower)
    if total == 0 or not dr.all(dr.isfinite(mass))[0]:
        return None
    start, end, source = (dr.gather(mi.UInt32, x, chosen) for x in (start, end, source))
    weight = mi.Float(mass / samples) / dr.gather(mi.Float, importance, chosen)
    weight *= dr.gather(mi.Float, sources.weight, source)
    dr.eval(start, end, source, weight)
    return start, end, source, weight


@dataclass
class BoundaryTerm:
    """Points on curves of the film at which the integrand jumps."""

    moving: object      #: ``Point2f``, attached: position in pixels relative to the crop window
    tangent: object     #: ``Vector2f``: its derivative along the edge
    source: object      #: ``UInt32``: which light sample casts the shadow
    weight: object      #: ``Float``
    via: object = None      #: ``Vector3f``: direction from the visible surface to the one in question
    lit: object = None      #: ``Point3f``: the point there on the boundary of the shadow
    jump: object = None     #: per film channel, the value on the left of the tangent less the other

    @property
    def film(self):
        """The present position."""
        return dr.detach(self.moving)

    def sides(self, distance=0.02):
        """Film positions on either side of the curve."""
        normal = mi.Vector2f(-self.tangent.y, self.tangent.x) * (distance / dr.norm(self.tangent))
        return self.film + normal, self.film - normal

    def swept(self, warp):
        """Weighted area that the curve sweeps over the film, relative to the warp; attached."""
        shifted, _ = warp(self.film)
        motion = mi.Vector2f(self.moving - shifted)
        return self.weight * (self.tangent.y * motion.x - self.tangent.x * motion.y)


def shadow_points(scene, sensor, mesh, table, sources, samples, sampler, bounces):
    """Draws points on the shadow boundaries that a mesh causes, and yields those that are seen.

    There are two kinds: the shadows that the edges cast, and the edges themselves, where the mesh
    turns away from the light (its shading normals do so elsewhere, so the light jumps there). Both
    are seen directly and, with ``bounces`` = 1, also in the light that the surface behind a camera
    ray receives from there.
    """
    drawn = _sample_edges(mesh, table, sources, samples, sampler)
    if drawn is None:
        return
    random = sampler.clone()
    random.seed(dr.opaque(mi.UInt32, int(sampler.next_1d()[0] * 2**24)), dr.width(drawn[0]))
    drawn = (*drawn, random.next_1d(), random.next_2d())
    dr.eval(drawn)
    for bounce in range(bounces + 1):
        for cast in (True, False):
            term = _seen_points(scene, sensor, mesh, sources, drawn, cast, bounce)
            if term is not None:
                yield term


def _project_along(scene, p, towards):
    """The next surface from a point away from ``towards``: hit point, normal, validity; attached."""
    lift = 1e-4 * (1 + dr.max(dr.abs(dr.detach(p))))
    ray = mi.Ray3f(mi.Point3f(p - towards * lift), -towards)
    with dr.suspend_grad():
        pi = scene.ray_intersect_preliminary(dr.detach(ray))
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal)
    return mi.Point3f(si.p), dr.detach(si.n), pi.is_valid()


def _slide(vector, normal, along):
    """The vector projected along a direction on the plane with the given normal."""
    return vector - along * (dr.dot(normal, vector) / dr.dot(normal, along))


def _follow(scene, mesh, sources, start, end, source, t, via, cast, bounce):
    """From points on edges to what a camera may see of their shadow.

    Returns the visible point and the shadow point, attached; the derivative of the former along the
    edge; and whether there is one.
    """
    positions = mesh.vertex_positions_buffer()
    a, b = dr.gather(mi.Point3f, positions, start), dr.gather(mi.Point3f, positions, end)
    p = mi.Point3f(dr.lerp(a, b, t))
    along, valid = dr.detach(b - a), mi.Bool(True)
    if cast:
        y, z = p, dr.gather(mi.Vector3f, dr.ravel(sources.position), source)
        towards = dr.normalize(mi.Point3f(z) - y) if sources.is_point else z
        p, normal, valid = _project_along(scene, y, towards)
        if sources.is_point:
            along *= dr.norm(dr.detach(p) - z) / dr.norm(dr.detach(y) - z)
        along = _slide(along, normal, dr.detach(towards))
    lit = p
    if bounce:
        p, normal, hit = _project_along(scene, p, via)
        along = _slide(along, normal, via)
        valid &= hit
    return p, lit, along, valid


def _seen_points(scene, sensor, mesh, sources, drawn, cast, bounce):
    film = sensor.film()
    *drawn, weight, t, sample = drawn
    via = mi.warp.square_to_uniform_sphere(sample)
    if bounce:
        weight = weight * (4 * dr.pi)
    p, lit, _, seen = _follow(scene, mesh, sources, *drawn, t, via, cast, bounce)
    # The camera has to see the point, and the film to cover it.
    viewpoint = mi.Point3f(dr.detach(sensor.world_transform()).translation())
    offset = p - viewpoint
    distance = dr.norm(offset)
    seen &= (dr.detach(sensor.world_transform()).inverse() @ p).z > sensor.near_clip()
    c = project_to_film(sensor, p)
    border = film.rfilter().border_size() if film.sample_border() else 0
    seen &= dr.all((c > -border) & (c < mi.Point2f(film.crop_size()) + border))
    seen &= ~scene.ray_test(mi.Ray3f(viewpoint, offset / distance, distance * (1 - 1e-3), 0.0, mi.Color0f()),
                            seen)
    kept = dr.compress(seen)
    if dr.width(kept) == 0:
        return None
    start, end, source = (dr.gather(mi.UInt32, x, kept) for x in drawn)
    weight, t = dr.gather(mi.Float, weight, kept), dr.gather(mi.Float, t, kept)
    via = mi.warp.square_to_uniform_sphere(dr.gather(mi.Point2f, dr.ravel(sample), kept))
    dr.eval(start, end, source, weight, t, via)

    with dr.resume_grad():
        p, lit, along, valid = _follow(scene, mesh, sources, start, end, source, t, via, cast, bounce)
        moving = project_to_film(sensor, p)
    p = dr.detach(p)
    step = 1e-3 * dr.norm(p - viewpoint) / dr.maximum(dr.norm(along), 1e-20)
    tangent = mi.Vector2f(project_to_film(sensor, p + along * step) -
                          project_to_film(sensor, p - along * step)) / (2 * step)
    usable = valid & dr.isfinite(dr.squared_norm(tangent)) & (dr.squared_norm(tangent) > 0)
    return BoundaryTerm(moving, dr.select(usable, tangent, mi.Vector2f(1, 0)), source,
                        dr.select(usable, weight, 0), via if bounce else None, dr.detach(lit))
