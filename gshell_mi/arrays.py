"""Names of Dr.Jit arrays for annotations, where the caller decides on the backend.

Dr.Jit has classes of its own for each backend, with and without derivatives, and the lattices and the
extraction run on whichever the fields given to them belong to. So to the type checker each of these names is
any Dr.Jit array, kept apart from numbers, NumPy arrays and ``None``; to readers they tell what is in it. Code
that runs in a Mitsuba variant uses the names of the variant instead, ``mi.Float`` and so on.
"""

from typing import TYPE_CHECKING, TypeAlias, TypeVar

import drjit as dr

if TYPE_CHECKING:
    from drjit import AnyArray
else:
    AnyArray = dr.ArrayBase

Bool: TypeAlias = AnyArray
"""One truth value per entry."""
UInt32: TypeAlias = AnyArray
"""One unsigned number of 32 bits per entry: an id, an index, a count or a set of bits."""
UInt64: TypeAlias = AnyArray
"""The same of 64 bits."""
Float: TypeAlias = AnyArray
"""One single-precision number per entry."""
Array3f: TypeAlias = AnyArray
"""Three single-precision numbers per entry, ``x``, ``y`` and ``z``."""
Field: TypeAlias = AnyArray
"""Numbers or vectors of any type, one per lattice vertex; or flat, with any number of channels."""
Array3u: TypeAlias = AnyArray
"""Three unsigned numbers per entry: the corners of triangles."""

ArrayT = TypeVar("ArrayT", bound=AnyArray)
"""The same type of array as another one in the signature."""
