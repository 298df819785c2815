"""Signs of a field, one bit per vertex, in words of 32; and the numbers of the bits that are set."""

import drjit as dr

from ..arrays import Bool, Float, UInt32

#: Values below this are negative. Not 0: some threads flush denormal numbers to 0 and others do not.
NEGATIVE = -(2.0**-126)


def pack_signs(s: Float) -> UInt32:
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


def is_set(words: UInt32, vertex: UInt32, active: Bool | bool = True) -> Bool:
    """Whether the bits of vertices are set; of signs: whether the vertices are inside."""
    return dr.gather(type(words), words, vertex >> 5, active) >> (vertex & 31) & 1 == 1


def expand(bits: UInt32, log2_slots: int) -> tuple[UInt32, UInt32]:
    """The set bits of an array of bit sets in order, as (index of the set, number of the bit)."""
    uint_t = type(bits)
    mask = (1 << log2_slots) - 1
    lane = dr.arange(uint_t, dr.width(bits) << log2_slots)
    if dr.width(lane):  # literals of size 1 do not go together with arrays of size 0
        lane = dr.compress(dr.gather(uint_t, bits, lane >> log2_slots) >> (lane & mask) & 1 == 1)
    if dr.width(lane) == 0:
        return lane, lane
    return lane >> log2_slots, lane & mask


def set_bits(words: UInt32) -> UInt32:
    """The numbers of the set bits of a stream of words."""
    uint_t = type(words)
    dr.eval(words)
    found = dr.compress(words != 0)
    if dr.width(found) == 0:
        return found
    owner, bit = expand(dr.gather(uint_t, words, found), 5)
    return dr.gather(uint_t, found, owner) * 32 + bit
