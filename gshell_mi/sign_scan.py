"""The signs of a field at the lattice vertices, one bit each, and the cells in which they change."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

from .lattice import MISSING, BccLattice, Lattice

if TYPE_CHECKING:
    from .block_lattice import BlockLattice

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


def active_cells(s: Any, lattice: Lattice | BlockLattice) -> tuple[Any, Any]:
    """Cells whose corners have different signs, by their lowest vertex, and few others.

    This is the one pass over the whole field, so the field is read once and packed into one bit per
    vertex; a neighbour is then a shift in the stream of bits. The vertices at the upper borders count
    as cells too, for the edges that they own; their corners outside the lattice are wrapped around.

    Returns:
        The cells and the words of signs, 32 vertices each: bit set for inside.
    """
    if isinstance(lattice, Lattice):
        inside = closed_signs(pack_signs(s), lattice)
        return sign_changes(inside, lattice), inside
    inside = lattice.signs(s)
    if lattice.lattice.closes_at_border:
        inside &= ~lattice.border()
    dr.eval(inside)
    return _sign_changes_in_blocks(inside, lattice), inside


def pack_signs(s: Any) -> Any:
    """Words of 32 signs; bit i of word w: the value 32 w + i is negative. Missing values repeat the last."""
    uint_t = dr.uint32_array_t(type(s))
    word = dr.arange(uint_t, -(-dr.width(s) // 32))
    last = dr.opaque(uint_t, dr.width(s) - 1)
    inside = dr.zeros(uint_t)
    for bit in range(32):
        value = dr.gather(type(s), s, dr.minimum(word * 32 + bit, last))
        inside |= dr.select(value < NEGATIVE, uint_t(1 << bit), 0)
    dr.eval(inside)
    return inside


def closed_signs(inside: Any, lattice: Lattice) -> Any:
    """The words of signs, where the lattice closes at its border without the bits there; changes them."""
    if lattice.closes_at_border:
        border = border_vertices(lattice, type(inside))
        others = ~(type(inside)(1) << (border & 31))
        dr.scatter_reduce(dr.ReduceOp.And, inside, others, border >> 5, mode=dr.ReduceMode.Local)
        dr.eval(inside)
    return inside


def is_inside(inside: Any, vertex: Any, active: Any = True) -> Any:
    """Whether vertices are inside, by the words of signs."""
    return dr.gather(type(inside), inside, vertex >> 5, active) >> (vertex & 31) & 1 == 1


def sign_changes(inside: Any, lattice: Lattice) -> Any:
    """The cells of a whole lattice that have corners of different signs."""
    uint_t = type(inside)
    word = dr.arange(uint_t, dr.width(inside))
    stride = dr.opaque(uint_t, lattice.stride)
    active = dr.zeros(uint_t)
    if isinstance(lattice, BccLattice):
        in_second = ~_bits_before(word, lattice.stride**3)
        for corner in range(1, 8):
            first, second = (_shifted(inside, word, dr.opaque(uint_t, offset >> 5 & MISSING),
                                      dr.opaque(uint_t, offset & 31))
                             for offset in (lattice.corner_offset(corner, grid) for grid in (False, True)))
            active |= (first & ~in_second | second & in_second) ^ inside
    else:
        for corner in range(1, 8):
            offset = corner_offset(uint_t(corner), stride)
            active |= _shifted(inside, word, offset >> 5, offset & 31) ^ inside
    return _set_bits(active & _bits_before(word, lattice.vertex_count))


def vertices_near(cells: Any, lattice: Lattice, reach: int) -> Any:
    """Ids of the vertices within ``reach`` along each axis of a cell's corners, and few others; ascending.

    Args:
        cells: the lowest vertices of the cells, of a whole lattice.
        reach: in vertices of a cubic grid.
    """
    uint_t = type(cells)
    if dr.width(cells) == 0:
        return cells
    strides = [1, lattice.stride, lattice.stride**2]
    # The bits can only move down, so all begin at the top of what is near to them.
    up = reach * sum(strides)
    words = -(-(lattice.vertex_count + up) // 32)
    near = dr.zeros(uint_t, words)
    for corner in range(8):
        vertex = lattice.corner(cells, uint_t(corner))
        exists = vertex < dr.opaque(uint_t, lattice.vertex_count)
        at = vertex + dr.opaque(uint_t, up)
        dr.scatter_reduce(dr.ReduceOp.Or, near, uint_t(1) << (at & 31), at >> 5, exists)
    word = dr.arange(uint_t, words)
    for stride in strides:
        covered, missing = 1, 2 * reach
        while missing:
            step = min(covered, missing)
            offset = dr.opaque(uint_t, step * stride)
            near |= _shifted(near, word, offset >> 5, offset & 31)
            dr.eval(near)
            covered, missing = covered + step, missing - step
    return _set_bits(near & _bits_before(word, lattice.vertex_count))


def _shifted(inside: Any, word: Any, words: Any, bits: Any) -> Any:
    """The signs that lie ``words`` and ``bits`` after those of each word; arbitrary where there are none."""
    last = dr.opaque(type(word), dr.width(inside) - 1)
    low = dr.gather(type(word), inside, dr.minimum(word + words, last))
    high = dr.gather(type(word), inside, dr.minimum(word + words + 1, last))
    return low >> bits | high << (31 - bits) << 1


def _bits_before(word: Any, vertex: int) -> Any:
    """Per word the bits of the vertices before ``vertex``."""
    uint_t = type(word)
    whole, rest = dr.opaque(uint_t, vertex // 32), dr.opaque(uint_t, vertex % 32)
    part = (dr.opaque(uint_t, 1) << rest) - 1
    return dr.select(word < whole, MISSING, dr.select(word == whole, part, 0))


def _sign_changes_in_blocks(inside: Any, blocks: BlockLattice) -> Any:
    """The same of stored vertices. What is not stored has the sign of the edge."""
    uint_t = type(inside)
    row = dr.arange(uint_t, dr.width(inside))
    active = dr.zeros(uint_t)
    for corner in range(1, 8):
        near = dr.gather(uint_t, blocks.upper, row * 8 + (corner & 6))
        exists = near != MISSING
        other = dr.gather(uint_t, inside, near, exists)
        compared = dr.select(exists, blocks.exists, 0)
        if corner & 1:
            near = dr.gather(uint_t, blocks.upper, row * 8 + corner)
            follows = near != MISSING
            other = other >> 1 | dr.gather(uint_t, inside, near, follows) << 31
            compared = compared >> 1 | dr.select(follows, uint_t(1 << 31), 0)
        active |= (other ^ inside) & compared
    return _set_bits(active)


def _set_bits(words: Any) -> Any:
    """The numbers of the set bits of a stream of words."""
    uint_t = type(words)
    dr.eval(words)
    found = dr.compress(words != 0)
    if dr.width(found) == 0:
        return found
    owner, bit = expand(dr.gather(uint_t, words, found), 5)
    return dr.gather(uint_t, found, owner) * 32 + bit


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
