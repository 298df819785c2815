"""The edges of a scene's meshes at which the image is discontinuous for a pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..arrays import AnyArray
from .edge_table import SIZE_INDEPENDENT, EdgeTable, join
from .resampling import expand
from .shading_rims import shading_rims


@dataclass
class ScreenEdges:
    """Straight pieces of silhouette, projected to the film.

    Coordinates are pixels relative to the film's crop window, as in ``sensor.sample_direction``.
    """

    a: mi.Point2f  #: attached: first end point
    b: mi.Point2f  #: attached: second end point


def silhouette_mask(
    positions: mi.Float, faces: mi.UInt32, table: EdgeTable, viewpoint: mi.Point3f
) -> mi.Bool:
    """Which directed edges carry the silhouette seen from a point.

    An edge carries it when all its faces lie on one side of the plane through the edge and the
    viewpoint: open edges always do, and edges between a face turned to the viewpoint and one turned
    away. The test does not depend on how the faces are oriented.

    Returns a ``Bool`` of width 3F, true at the representative of each such edge of the
    ``EdgeTable``.

    >>> from gshell_mi.integrators.edge_table import build_edge_table
    >>> tet = mi.Float(0, 0, 0,  1, 0, 0,  0, 1, 0,  0, 0, 1)
    >>> faces = mi.UInt32(0, 2, 1,  0, 1, 3,  0, 3, 2,  1, 2, 3)
    >>> table = build_edge_table(tet, faces)
    >>> dr.count(silhouette_mask(tet, faces, table, mi.Point3f(0.2, 0.2, -5)))[0]
    3
    >>> dr.count(silhouette_mask(tet, faces, table, mi.Point3f(5, -4, -5)))[0]
    4
    """
    n = dr.width(faces)
    positions = dr.detach(positions)
    face = dr.arange(mi.UInt32, n) // 3
    corners = [
        dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, faces, 3 * face + k)) - viewpoint
        for k in range(3)
    ]
    towards = dr.dot(corners[0], dr.cross(corners[1], corners[2])) < 0
    side = dr.select(towards == table.forward, mi.Int32(1), mi.Int32(-1))
    sides = dr.zeros(mi.Int32, n)
    dr.scatter_add(sides, side, table.edge, table.valid, mode=SIZE_INDEPENDENT)
    dr.eval(sides)
    return (table.degree > 0) & (dr.abs(sides) == table.degree)


def crease_mask(mesh: mi.Mesh, table: EdgeTable, angle: float) -> mi.Bool:
    """Which directed edges carry a jump of the shading although both their faces are seen.

    These are edges with a dihedral angle above ``angle`` (degrees) between flat-shaded faces, and
    edges at which vertices are duplicated, so that normals or texture coordinates may jump.
    """
    flat = mesh.has_face_normals() or not mesh.has_vertex_normals()
    positions, faces = dr.detach(mesh.vertex_positions_buffer()), mesh.faces_buffer()
    n = dr.width(faces)
    face = dr.arange(mi.UInt32, n) // 3
    p0, p1, p2 = (
        dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, faces, 3 * face + k)) for k in range(3)
    )
    normal = dr.normalize(dr.cross(p1 - p0, p2 - p0))
    normal = dr.select(table.forward, normal, -normal)  # differ in sign where orientation agrees
    total = dr.zeros(mi.Vector3f, n)
    for k in range(3):
        dr.scatter_add(total[k], normal[k], table.edge, table.valid, mode=SIZE_INDEPENDENT)
    sharp = (table.degree == 2) & (dr.squared_norm(total) > 2 - 2 * dr.cos(dr.deg2rad(angle)))
    if flat:
        return sharp
    return table.split & (table.degree == 2) & (sharp | mesh.has_vertex_texcoords())


def _clip(lo: mi.Float, hi: mi.Float, inside_a: mi.Float, inside_b: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Narrows the interval [lo, hi] of a segment to where the linear function is positive."""
    cut = inside_a / (inside_a - inside_b)
    lo = dr.select((inside_a < 0) & (inside_b >= 0), dr.maximum(lo, cut), lo)
    hi = dr.select((inside_b < 0) & (inside_a >= 0), dr.minimum(hi, cut), hi)
    return lo, dr.select((inside_a < 0) & (inside_b < 0), -1, hi)


def _compact(selected: mi.Bool, *arrays: AnyArray) -> list[AnyArray]:
    index = dr.compress(selected)
    return [dr.gather(type(x), x, index) for x in arrays]


def _mesh_pieces(
    mesh: mi.Mesh,
    table: EdgeTable,
    sensor: mi.Sensor,
    crease_angle: float,
    margin: float,
    piece_length: float,
    to_camera: mi.Transform4f,
    near: float,
) -> tuple[mi.UInt32, mi.UInt32, mi.Float, mi.Float] | None:
    """The silhouette of one mesh in pieces: vertices of the edge, and the interval of it they span."""
    positions, faces = dr.detach(mesh.vertex_positions_buffer()), mesh.faces_buffer()
    viewpoint = mi.Point3f(dr.detach(sensor.world_transform()).translation())
    selected = silhouette_mask(positions, faces, table, viewpoint) | crease_mask(mesh, table, crease_angle)
    start, end = _compact(selected, table.start, table.end)
    if dr.width(start) == 0:
        return None
    p, q = dr.gather(mi.Point3f, positions, start), dr.gather(mi.Point3f, positions, end)

    # Near plane, in camera space
    s0, s1 = _clip(mi.Float(0), mi.Float(1), (to_camera @ p).z - near, (to_camera @ q).z - near)
    p, q = dr.lerp(p, q, s0), dr.lerp(p, q, s1)
    zp, zq = dr.maximum((to_camera @ p).z, near), dr.maximum((to_camera @ q).z, near)

    # Frame with its margin, on the film
    size = mi.Vector2f(sensor.film().crop_size())
    u, v = project_to_film(sensor, p), project_to_film(sensor, q)
    t0, t1 = mi.Float(0), mi.Float(1)
    for k in range(2):
        t0, t1 = _clip(t0, t1, u[k] + margin, v[k] + margin)
        t0, t1 = _clip(t0, t1, size[k] + margin - u[k], size[k] + margin - v[k])
    inside = (s1 > s0) & (t1 > t0) & dr.isfinite(dr.squared_norm(u) + dr.squared_norm(v))
    count = dr.maximum(mi.UInt32(dr.ceil(dr.norm(v - u) * (t1 - t0) / piece_length)), 1)
    dr.eval(inside, start, end, count, s0, s1, t0, t1, zp, zq)
    start, end, count, s0, s1, t0, t1, zp, zq = _compact(inside, start, end, count, s0, s1, t0, t1, zp, zq)
    if dr.width(start) == 0:
        return None

    edge, number, _ = expand(count)
    number = mi.Float(number)
    step = dr.rcp(mi.Float(dr.gather(mi.UInt32, count, edge)))
    start, end, s0, s1, t0, t1, zp, zq = (
        dr.gather(type(x), x, edge) for x in (start, end, s0, s1, t0, t1, zp, zq)
    )

    def along(x: mi.Float) -> mi.Float:
        t = dr.lerp(t0, t1, x)
        s = t * zp / dr.fma(t, zp, (1 - t) * zq)  # film to edge parameter, perspective-correct
        return dr.lerp(s0, s1, s)

    return start, end, along(number * step), along((number + 1) * step)


def project_to_film(sensor: mi.Sensor, p: mi.Point3f) -> mi.Point2f:
    """Pixel coordinates of world points, relative to the crop window; attached to both arguments."""
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    return mi.Point2f(sensor.sample_direction(it, mi.Point2f(0.5))[0].uv)


def _seen(scene: mi.Scene, viewpoint: mi.Point3f, p: mi.Point3f, q: mi.Point3f) -> mi.Bool:
    """Whether anything of a piece can be seen: false only if all of a few test rays are blocked."""
    seen = dr.zeros(mi.Bool, dr.width(p))
    for t in (0.02, 0.5, 0.98):
        target = dr.lerp(p, q, t)
        d = target - viewpoint
        distance = dr.norm(d)
        ray = mi.Ray3f(viewpoint, d / distance, distance * (1 - 2e-3), 0.0, mi.Color0f())
        seen |= ~scene.ray_test(ray)
    return seen


def _visible_pieces(
    scene: mi.Scene,
    sensor: mi.Sensor,
    mesh: mi.Mesh,
    start: mi.UInt32,
    end: mi.UInt32,
    lo: mi.Float,
    hi: mi.Float,
    cull: bool,
) -> tuple[mi.Point2f, mi.Point2f] | None:
    """Projected pieces of a mesh's edges, attached, without hidden ones; ``None`` if there are none."""
    if cull:
        viewpoint = mi.Point3f(dr.detach(sensor.world_transform()).translation())
        flat = dr.detach(mesh.vertex_positions_buffer())
        p, q = dr.gather(mi.Point3f, flat, start), dr.gather(mi.Point3f, flat, end)
        seen = _seen(scene, viewpoint, dr.lerp(p, q, lo), dr.lerp(p, q, hi))
        dr.eval(seen, start, end, lo, hi)
        start, end, lo, hi = _compact(seen, start, end, lo, hi)
        if dr.width(start) == 0:
            return None
    dr.eval(start, end, lo, hi)
    with dr.resume_grad():
        positions = mesh.vertex_positions_buffer()
        p, q = dr.gather(mi.Point3f, positions, start), dr.gather(mi.Point3f, positions, end)
        return project_to_film(sensor, dr.lerp(p, q, lo)), project_to_film(sensor, dr.lerp(p, q, hi))


def _visible_rims(
    scene: mi.Scene,
    sensor: mi.Sensor,
    a: mi.Point3f,
    b: mi.Point3f,
    margin: float,
    to_camera: mi.Transform4f,
    near: float,
    cull: bool,
) -> tuple[mi.Point2f, ...] | None:
    """The same of chords in world space, which are short enough not to be cut."""
    viewpoint = mi.Point3f(dr.detach(sensor.world_transform()).translation())
    p, q = mi.Point3f(dr.detach(a)), mi.Point3f(dr.detach(b))
    inside = ((to_camera @ p).z > near) & ((to_camera @ q).z > near)
    u, v = project_to_film(sensor, p), project_to_film(sensor, q)
    size = mi.Vector2f(sensor.film().crop_size())
    inside &= dr.all((dr.maximum(u, v) > -margin) & (dr.minimum(u, v) < size + margin))
    inside &= dr.isfinite(dr.squared_norm(u) + dr.squared_norm(v))
    if cull:
        inside &= _seen(scene, viewpoint, p, q)
    index = dr.compress(inside)
    if dr.width(index) == 0:
        return None
    with dr.resume_grad():
        return tuple(
            project_to_film(sensor, dr.gather(mi.Point3f, points, index, mode=SIZE_INDEPENDENT))
            for points in (a, b)
        )


def screen_edges(
    scene: mi.Scene,
    tables: list[tuple[mi.Mesh, EdgeTable]],
    sensor: mi.Sensor,
    margin: float,
    *,
    piece_length: float = 4.0,
    cull: bool = True,
    crease_angle: float = 0.1,
) -> ScreenEdges | None:
    """All silhouettes and shading rims of the scene's meshes, projected and cut into short pieces.

    Args:
        scene, sensor: the scene, and a perspective sensor.
        tables: what ``scene_edge_tables`` gives for the scene.
        margin: width in pixels of the band around the crop window from which edges are kept.
        piece_length: greatest length of a piece in pixels.
        cull: leave out pieces that other surfaces hide.
        crease_angle: dihedral angle in degrees from which an edge between flat-shaded faces counts.

    Returns:
        ``ScreenEdges``, or ``None`` if there are none.
    """
    to_camera = dr.detach(sensor.world_transform()).inverse()
    near = max(sensor.near_clip(), 1e-6)
    viewpoint = mi.Point3f(dr.detach(sensor.world_transform()).translation())
    parts = []
    for shape, table in tables:
        rims = shading_rims(shape, viewpoint)
        if rims is not None:
            parts.append(_visible_rims(scene, sensor, *rims, margin, to_camera, near, cull))
        pieces = _mesh_pieces(shape, table, sensor, crease_angle, margin, piece_length, to_camera, near)
        if pieces is not None:
            parts.append(_visible_pieces(scene, sensor, shape, *pieces, cull))
    parts = [part for part in parts if part is not None]
    if not parts:
        return None
    with dr.resume_grad():
        return ScreenEdges(*(join([part[k] for part in parts]) for k in range(2)))
