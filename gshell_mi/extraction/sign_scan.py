"""The signs of a field at the lattice vertices, and the cells in which they change."""

from typing import Any

import drjit as dr

from ..lattice import Lattice
from .narrow_band import NarrowBand

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


def active_cells(s: Any, lattice: Lattice, closed: bool = False, band: NarrowBand | None = None) -> Any:
    """Cells whose corners have different signs, by their lowest vertex, and few others.

    This is the one pass over the whole field, so the field is read once and packed into one bit per
    vertex; a neighbour is then a shift in the stream of bits. The vertices at the upper borders count
    as cells too, for the edges that they own; their corners outside the lattice are wrapped around.

    Args:
        closed: vertices on the border count as outside.
        band: where to look; it is moved along with the cells that are found.
    """
    uint_t = dr.uint32_array_t(type(s))
    if band is None or band.is_due(lattice):
        word = dr.arange(uint_t, -(-lattice.vertex_count // 32))
        inside = _pack_signs(s, word)
    else:
        word, needed = band.words(uint_t)
        inside = dr.empty(uint_t, -(-lattice.vertex_count // 32))
        if dr.width(needed):
            dr.scatter(inside, _pack_signs(s, needed), needed, mode=dr.ReduceMode.Permute)
            dr.eval(inside)  # side effects of different sizes have no order within one evaluation
    if closed:
        border = border_vertices(lattice, uint_t)
        others = ~(uint_t(1) << (border & 31))
        dr.scatter_reduce(dr.ReduceOp.And, inside, others, border >> 5, mode=dr.ReduceMode.Local)
    dr.eval(inside)
    cell = _changes(inside, word, lattice) if dr.width(word) else word
    if band is not None:
        band.follow(cell, lattice)
    return cell


def _pack_signs(s: Any, word: Any) -> Any:
    """Bit i of the result: vertex 32 * word + i is inside."""
    uint_t = type(word)
    last_vertex = dr.opaque(uint_t, dr.width(s) - 1)
    inside = dr.zeros(uint_t)
    for bit in range(32):
        vertex = dr.minimum(word * 32 + bit, last_vertex)
        inside |= dr.select(dr.gather(type(s), s, vertex) < NEGATIVE, uint_t(1 << bit), 0)
    dr.eval(inside)
    return inside


def _changes(inside: Any, word: Any, lattice: Lattice) -> Any:
    """The cells of the given words that have corners of different signs."""
    uint_t = type(word)
    stride = dr.opaque(uint_t, lattice.stride)
    count = lattice.vertex_count
    last_vertex, last_word = dr.opaque(uint_t, count - 1), dr.opaque(uint_t, (count - 1) // 32)
    own = dr.gather(uint_t, inside, word)
    active = dr.zeros(uint_t)
    for corner in range(1, 8):
        offset = corner_offset(uint_t(corner), stride)
        low, shift = word + (offset >> 5), offset & 31
        first = dr.gather(uint_t, inside, dr.minimum(low, last_word))
        second = dr.gather(uint_t, inside, dr.minimum(low + 1, last_word))
        active |= (first >> shift | second << (31 - shift) << 1) ^ own
    beyond = ~dr.opaque(uint_t, 0) << (last_vertex & 31) << 1  # bits past the last vertex
    active &= ~dr.select(word == last_word, beyond, 0)

    found = dr.compress(active != 0)
    if dr.width(found) == 0:
        return found
    owner, bit = expand(dr.gather(uint_t, active, found), 5)
    return dr.gather(uint_t, word, dr.gather(uint_t, found, owner)) * 32 + bit


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
