"""One pass over the signs of a whole lattice: the cells in which they change, and what is near."""

import drjit as dr

from ..arrays import Float, UInt32
from .lattice import MISSING, BccLattice, Lattice, corner_offset
from .sign_words import pack_signs, set_bits


def active_cells(s: Float, lattice: Lattice) -> tuple[UInt32, UInt32]:
    """Cells whose corners have different signs, by their lowest vertex, and few others.

    The field is read once and packed into one bit per vertex; a neighbour is then a shift in the stream of
    bits. The vertices at the upper borders count as cells too, for the edges that they own; their corners
    outside the lattice are wrapped around.

    Returns:
        The cells and the words of signs, 32 vertices each: bit set for inside.
    """
    inside = closed_signs(pack_signs(s), lattice)
    return sign_changes(inside, lattice), inside


def closed_signs(inside: UInt32, lattice: Lattice) -> UInt32:
    """The words of signs, where the lattice closes at its border without the bits there; changes them."""
    if lattice.closes_at_border:
        border = border_vertices(lattice, type(inside))
        others = ~(type(inside)(1) << (border & 31))
        dr.scatter_reduce(dr.ReduceOp.And, inside, others, border >> 5, mode=dr.ReduceMode.Local)
        dr.eval(inside)
    return inside


def sign_changes(inside: UInt32, lattice: Lattice) -> UInt32:
    """The cells of a whole lattice that have corners of different signs."""
    uint_t = type(inside)
    word = dr.arange(uint_t, dr.width(inside))
    stride = dr.opaque(uint_t, lattice.stride)
    active = dr.zeros(uint_t)
    if isinstance(lattice, BccLattice):
        in_second = ~_bits_before(word, lattice.stride**3)
        for corner in range(1, 8):
            first, second = (
                _shifted(
                    inside, word, dr.opaque(uint_t, offset >> 5 & MISSING), dr.opaque(uint_t, offset & 31)
                )
                for offset in (lattice.corner_offset(corner, grid) for grid in (False, True))
            )
            active |= (first & ~in_second | second & in_second) ^ inside
    else:
        for corner in range(1, 8):
            offset = corner_offset(uint_t(corner), stride)
            active |= _shifted(inside, word, offset >> 5, offset & 31) ^ inside
    return set_bits(active & _bits_before(word, lattice.vertex_count))


def vertices_near(cells: UInt32, lattice: Lattice, reach: int) -> UInt32:
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
    return set_bits(near & _bits_before(word, lattice.vertex_count))


def _shifted(inside: UInt32, word: UInt32, words: UInt32, bits: UInt32) -> UInt32:
    """The signs that lie ``words`` and ``bits`` after those of each word; arbitrary where there are none."""
    last = dr.opaque(type(word), dr.width(inside) - 1)
    low = dr.gather(type(word), inside, dr.minimum(word + words, last))
    high = dr.gather(type(word), inside, dr.minimum(word + words + 1, last))
    return low >> bits | high << (31 - bits) << 1


def _bits_before(word: UInt32, vertex: int) -> UInt32:
    """Per word the bits of the vertices before ``vertex``."""
    uint_t = type(word)
    whole, rest = dr.opaque(uint_t, vertex // 32), dr.opaque(uint_t, vertex % 32)
    part = (dr.opaque(uint_t, 1) << rest) - 1
    return dr.select(word < whole, MISSING, dr.select(word == whole, part, 0))


def border_vertices(lattice: Lattice, uint_t: type[UInt32]) -> UInt32:
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
