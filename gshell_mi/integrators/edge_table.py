"""Unique edges of a triangle soup, found on the device by hashing.

The meshes of a fit change their connectivity in every iteration, so adjacency has to cost
milliseconds and must not compile kernels anew. A hash table with open addressing, filled by
compare-and-swap, does both; no sort is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..arrays import ArrayT

_EMPTY = 0xFFFFFFFF

#: How to add to arrays whose size changes: the automatic choice may bake the size into the kernel.
SIZE_INDEPENDENT = dr.ReduceMode.Local


@dr.syntax
def first_with_equal_key(keys: list[mi.UInt32], active: mi.Bool) -> mi.UInt32:
    """For each entry the index of the first entry that has an equal key.

    Args:
        keys: list of ``UInt32`` arrays of one width ``n``: the words of the keys.
        active: ``Bool``, width ``n``: entries that take part. Others get ``0xFFFFFFFF``.

    Returns:
        ``UInt32``, width ``n``.

    >>> key = mi.UInt32(7, 5, 7, 9)
    >>> r = first_with_equal_key([key], mi.Bool(True, True, True, False))
    >>> r[0], r[1], r[2], r[3] == 0xFFFFFFFF
    (0, 1, 0, True)
    """
    n = dr.width(keys[0])
    active = mi.Bool(active)
    size = 1 << max(4, (2 * n - 1).bit_length())
    table = dr.full(mi.UInt32, _EMPTY, size)
    mask = dr.opaque(mi.UInt32, size - 1)
    dr.eval(keys, active, table)

    h = mi.UInt32(0x9E3779B9)
    for word in keys:
        h = (h ^ word) * 0x85EBCA6B
        h ^= h >> 15
    h *= 0xC2B2AE35
    h ^= h >> 13

    index = dr.arange(mi.UInt32, n)
    slot = h & mask
    result = mi.UInt32(_EMPTY)
    while active:
        old, swapped = dr.scatter_cas(table, mi.UInt32(_EMPTY), index, slot, active)
        found = dr.select(swapped, index, old)
        equal = mi.Bool(True)
        for word in keys:
            equal &= dr.gather(mi.UInt32, word, found, active) == dr.gather(mi.UInt32, word, index, active)
        done = active & (swapped | equal)
        result = dr.select(done, found, result)
        slot = (slot + 1) & mask
        active &= ~done
    dr.eval(result)  # what an atomic returned cannot be computed a second time
    lowest = dr.full(mi.UInt32, _EMPTY, n)
    taking_part = result != _EMPTY
    dr.scatter_reduce(dr.ReduceOp.Min, lowest, index, result, taking_part, mode=SIZE_INDEPENDENT)
    return dr.select(taking_part, dr.gather(mi.UInt32, lowest, result, taking_part), _EMPTY)


@dataclass
class EdgeTable:
    """The directed edges of a mesh (three per face, in face order) and the edge each belongs to."""

    start: mi.UInt32  #: 3F: first vertex, an index into the mesh's own vertex buffer
    end: mi.UInt32  #: 3F: second vertex
    edge: mi.UInt32  #: 3F: representative directed edge
    forward: mi.Bool  #: 3F: whether it runs from the lower to the higher welded vertex
    valid: mi.Bool  #: 3F: false for the edges of degenerate and of repeated faces
    split: mi.Bool  #: 3F: its faces have different copies of an end point (at representatives)
    degree: mi.Int32  #: 3F: number of faces at the edge, stored at its representative


def build_edge_table(positions: mi.Float, faces: mi.UInt32) -> EdgeTable:
    """The edges of a mesh, vertices at exactly the same position counting as one.

    Welding by position keeps texture seams from looking like open boundaries. Faces with two equal
    (welded) corners are left out, so padding by degenerate faces is free, and so are faces whose
    corners are those of an earlier one, on whatever side: they would hide that an edge is open or a
    crease.

    Args:
        positions: ``Float``, 3V, interleaved.
        faces: ``UInt32``, 3F, vertex indices.

    >>> quad = mi.Float(0, 0, 0,  1, 0, 0,  1, 1, 0,  0, 1, 0)
    >>> table = build_edge_table(quad, mi.UInt32(0, 1, 2,  0, 2, 3,  0, 0, 0))
    >>> open_edges = table.degree == 1
    >>> dr.count(open_edges)[0], dr.count(table.degree == 2)[0]
    (4, 1)
    """
    positions = dr.detach(positions)
    faces = mi.UInt32(faces)
    dr.make_opaque(positions, faces)
    vertex_count, corner_count = dr.width(positions) // 3, dr.width(faces)

    vertex = dr.arange(mi.UInt32, vertex_count)
    # Adding zero turns -0 into +0, which compares equal but has other bits.
    words = [
        dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, positions, 3 * vertex + k) + 0.0)
        for k in range(3)
    ]
    welded = first_with_equal_key(words, dr.full(mi.Bool, True, vertex_count))
    corner = dr.arange(mi.UInt32, corner_count)
    face = corner // 3
    side = corner - 3 * face
    start = dr.gather(mi.UInt32, faces, corner)
    end = dr.gather(mi.UInt32, faces, 3 * face + dr.select(side == 2, 0, side + 1))
    a, b = (dr.gather(mi.UInt32, welded, v) for v in (start, end))
    valid = dr.gather(mi.UInt32, _first_with_equal_corners(welded, faces), face) == face
    forward = a < b
    edge = first_with_equal_key([dr.minimum(a, b), dr.maximum(a, b)], valid)

    degree = dr.zeros(mi.Int32, corner_count)
    dr.scatter_add(degree, mi.Int32(1), edge, valid, mode=SIZE_INDEPENDENT)
    copies = dr.zeros(mi.UInt32, corner_count)
    dr.scatter_add(copies, start + end, edge, valid, mode=SIZE_INDEPENDENT)
    split = copies != (start + end) * mi.UInt32(degree)
    dr.eval(start, end, edge, forward, valid, split, degree)
    return EdgeTable(start, end, edge, forward, valid, split, degree)


def _first_with_equal_corners(welded: mi.UInt32, faces: mi.UInt32) -> mi.UInt32:
    """For each face the first one with the same welded corners, in any order; 0xFFFFFFFF if two are equal."""
    face = dr.arange(mi.UInt32, dr.width(faces) // 3)
    a, b, c = (dr.gather(mi.UInt32, welded, dr.gather(mi.UInt32, faces, 3 * face + k)) for k in range(3))
    low, high = dr.minimum(a, dr.minimum(b, c)), dr.maximum(a, dr.maximum(b, c))
    return first_with_equal_key([low, a ^ b ^ c ^ low ^ high, high], (a != b) & (b != c) & (c != a))


def scene_edge_tables(scene: mi.Scene) -> list[tuple[mi.Mesh, EdgeTable]]:
    """Pairs of each mesh of the scene that has faces and its ``EdgeTable``."""
    return [
        (shape, build_edge_table(shape.vertex_positions_buffer(), shape.faces_buffer()))
        for shape in scene.shapes()
        if shape.is_mesh() and shape.face_count() > 0 and shape.vertex_count() > 2
    ]


def join(arrays: list[ArrayT]) -> ArrayT:
    """One array of several; ``dr.concat`` would bake the sizes into the kernel, scattering does not."""
    if len(arrays) == 1:
        return arrays[0]
    result = dr.zeros(type(arrays[0]), sum(dr.width(x) for x in arrays))
    offset = 0
    for x in arrays:
        index = dr.arange(mi.UInt32, dr.width(x)) + dr.opaque(mi.UInt32, offset)
        if dr.depth_v(x) == 1:
            dr.scatter(result, x, index, mode=dr.ReduceMode.Permute)
        else:
            for k in range(len(x)):
                dr.scatter(result[k], x[k], index, mode=dr.ReduceMode.Permute)
        offset += dr.width(x)
    return result
