"""The lattices on which the fields live, whole or stored around a surface."""

from .block_lattice import BlockLattice, block_count
from .lattice import (
    GRIDS,
    MISSING,
    MOST_CELLS,
    BccLattice,
    CubeLattice,
    CubicGrid,
    FlexiCubesLattice,
    Lattice,
    TetLattice,
    array_type,
    lattice_of,
    make_lattice,
)

__all__ = [
    "GRIDS",
    "MISSING",
    "MOST_CELLS",
    "BccLattice",
    "BlockLattice",
    "CubeLattice",
    "CubicGrid",
    "FlexiCubesLattice",
    "Lattice",
    "TetLattice",
    "array_type",
    "block_count",
    "lattice_of",
    "make_lattice",
]
