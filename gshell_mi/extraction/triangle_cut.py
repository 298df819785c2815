"""Cutting a triangle mesh by the sign at its vertices, with names for its edges instead of a search."""

import drjit as dr

from ..arrays import Array3u, UInt32
from .surface_mesh import concatenate


def cut_triangles(
    faces: Array3u, names: Array3u, name_count: int, kept_count: int
) -> tuple[Array3u, UInt32, UInt32]:
    """The part of a mesh around its first vertices, which ends within the edges to the others.

    Args:
        faces: vertex indices, ``Array3u``.
        names: per face the names of its edges, ``Array3u``: side i joins the corners i and i + 1. Both
            faces at an edge have the same name for it, below ``name_count``.
        kept_count: vertices that stay; the indices of the others are greater.

    Returns:
        ``faces`` (indices from ``kept_count`` on are cut vertices) and per cut vertex the kept vertex and the
        dropped one, the latter counted from the first dropped.
    """
    uint_t = type(faces.x)
    kept_opaque = dr.opaque(uint_t, kept_count)
    stays = [corner < kept_opaque for corner in faces]
    number = sum(dr.select(stay, uint_t(1), 0) for stay in stays)
    dr.eval(number)
    whole, mixed = dr.compress(number == 3), dr.compress((number == 1) | (number == 2))
    result = _take(faces, whole)
    if dr.width(mixed) == 0:
        return result, mixed, mixed

    faces, names = _take(faces, mixed), _take(names, mixed)
    alone_stays = dr.gather(uint_t, number, mixed) == 1
    stays = [corner < kept_opaque for corner in faces]
    # Turned so that the first corner is alone on its side.
    turn = dr.select(stays[1] == alone_stays, uint_t(1), dr.select(stays[2] == alone_stays, uint_t(2), 0))
    turn = dr.select(stays[0] == alone_stays, 0, turn)
    alone, second, third = _turned(faces, turn)
    side_out, _, side_back = _turned(names, turn)

    is_cut = dr.zeros(uint_t, name_count)
    for side in (side_out, side_back):
        dr.scatter(is_cut, uint_t(1), side)  # both faces write the same
    before = dr.prefix_reduce(dr.ReduceOp.Add, is_cut)
    cut_count = dr.sum(is_cut)[0]
    starts, ends = dr.empty(uint_t, cut_count), dr.empty(uint_t, cut_count)
    cuts = []
    for side, other in ((side_out, second), (side_back, third)):
        cut = dr.gather(uint_t, before, side)
        dr.scatter(starts, dr.select(alone_stays, alone, other), cut, mode=dr.ReduceMode.Permute)
        dr.scatter(ends, dr.select(alone_stays, other, alone) - kept_opaque, cut, mode=dr.ReduceMode.Permute)
        cuts.append(cut + kept_opaque)
    out, back = cuts
    faces_t = type(faces)
    first = faces_t(
        dr.select(alone_stays, alone, out),
        dr.select(alone_stays, out, second),
        dr.select(alone_stays, back, third),
    )
    dr.eval(first, starts, ends)
    second_face = _take(faces_t(out, third, back), dr.compress(~alone_stays))
    parts = [part for part in (result, first, second_face) if dr.width(part)]
    return concatenate(parts), starts, ends


def _take(values: Array3u, index: UInt32) -> Array3u:
    if dr.width(index) == 0:
        return dr.zeros(type(values), 0)
    taken = type(values)(*(dr.gather(type(index), component, index) for component in values))
    dr.eval(taken)
    return taken


def _turned(values: Array3u, turn: UInt32) -> list[UInt32]:
    return [
        dr.select(turn == 0, values[i], dr.select(turn == 1, values[(i + 1) % 3], values[(i + 2) % 3]))
        for i in range(3)
    ]
