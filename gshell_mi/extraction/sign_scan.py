"""The signs of a field at the lattice vertices, and the cells in which they change."""

from typing import Any

import drjit as dr

from ..lattice import Lattice

#: Values below this are negative. Not 0: some threads flush denormal numbers to 0 and others do not.
NEGATIVE = -(2.0**-126)


def corner_offset(corner: Any, stride: Any) -> Any:
    """Difference between the ids of a cell's corner (bits 0, 1, 2: x, y, z) and of its lowest vertex."""
    return (corner & 1) + (corner >> 1 & 1) * stride + (corner >> 2) * (stride * stride)


def expand(bits: Any, log2_slots: int) -> tuple[Any, Any]:
    """The set bits of an array of bit sets in order, as (index of the set, number of the bit)."""
    uint_t = type(bits)
    mask = (1 << log2_slots) - 1
    lane = dr.arange(uint_t, dr.width(bits) << log2_slots)
    if dr.width(lane):  # literals of size 1 do not go together with arrays of size 0
        lane = dr.compress(dr.gather(uint_t, bits, lane >> log2_slots) >> (lane & mask) & 1 == 1)
    if dr.width(lane) == 0:
        return lane, lane
    return lane >> log2_slots, lane & mask


def active_cells(s: Any, lattice: Lattice, closed: bool = False) -> Any:
    """Cells whose corners have different signs, by their lowest vertex, and few others.

    This is the one pass over the whole field, so the field is read once and packed into one bit per
    vertex; a neighbour is then a shift in the stream of bits. The vertices at the upper borders count
    as cells too, for the edges that they own; their corners outside the lattice are wrapped around.

    Args:
        closed: vertices on the border count as outside.
    """
    float_t = type(s)
    uint_t = dr.uint32_array_t(float_t)
    stride = dr.opaque(uint_t, lattice.stride)
    count = dr.width(s)
    word = dr.arange(uint_t, -(-count // 32))
    last_vertex, last_word = dr.opaque(uint_t, count - 1), dr.opaque(uint_t, (count - 1) // 32)
    inside = dr.zeros(uint_t)
    for bit in range(32):
        vertex = dr.minimum(word * 32 + bit, last_vertex)
        inside |= dr.select(dr.gather(float_t, s, vertex) < NEGATIVE, uint_t(1 << bit), 0)
    if closed:
        border = border_vertices(lattice, uint_t)
        others = ~(uint_t(1) << (border & 31))
        dr.scatter_reduce(dr.ReduceOp.And, inside, others, border >> 5, mode=dr.ReduceMode.Local)
    dr.eval(inside)

    active = dr.zeros(uint_t)
    for corner in range(1, 8):
        offset = corner_offset(uint_t(corner), stride)
        low, shift = word + (offset >> 5), offset & 31
        first = dr.gather(uint_t, inside, dr.minimum(low, last_word))
        second = dr.gather(uint_t, inside, dr.minimum(low + 1, last_word))
        active |= (first >> shift | second << (31 - shift) << 1) ^ inside
    beyond = ~dr.opaque(uint_t, 0) << (last_vertex & 31) << 1  # bits past the last vertex
    active &= ~dr.select(word == last_word, beyond, 0)

    words = dr.compress(active != 0)
    if dr.width(words) == 0:
        return words
    owner, bit = expand(dr.gather(uint_t, active, words), 5)
    return dr.gather(uint_t, words, owner) * 32 + bit


def border_vertices(lattice: Lattice, uint_t: type) -> Any:
    """Ids of the vertices on the six faces of the lattice; those on its edges more than once."""
    stride = dr.opaque(uint_t, lattice.stride)
    plane = stride * stride
    index = dr.arange(uint_t, 6 * lattice.stride**2)
    face = index // plane
    i = (index - face * plane) // stride
    j = index - face * plane - i * stride
    side = dr.select(face & 1 == 1, stride - 1, 0)
    along = dr.select(face < 2, 1, dr.select(face < 4, stride, plane))  # steps to the other side, i and j
    step_i = dr.select(face < 2, stride, 1)
    step_j = dr.select(face < 4, plane, stride)
    return side * along + i * step_i + j * step_j
