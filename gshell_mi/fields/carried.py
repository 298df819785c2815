"""Fields in blocks, and what an optimiser keeps for them, carried along when the blocks follow a surface."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import drjit as dr

from ..arrays import Bool, Float, UInt32
from ..lattice import MISSING, BlockLattice
from ..lattice.sign_words import is_set

if TYPE_CHECKING:
    import mitsuba as mi


class Carried:
    """Takes values from the stored vertices of one ``BlockLattice`` to those of another.

    What both store is copied. A vertex that is new takes the value of a nearest old one, and its signed
    distance grows away from the surface by a cell per cell.

    Args:
        before, after: blocks of the same lattice that have some in common.
    """

    def __init__(self, before: BlockLattice, after: BlockLattice):
        self.before, self.after = before, after

    @classmethod
    def following(cls, before: BlockLattice, cells: UInt32, sdf: Float, *, keep: bool) -> Carried:
        """To the blocks around a surface.

        Args:
            cells: where the surface is, as in ``SurfaceMesh.cells``.
            sdf: the signed distance before.
            keep: all blocks from before stay, too.
        """
        moves: list[Carried] = []

        def extended(after: BlockLattice) -> Float:
            moves.append(cls(before, after))
            return moves[0].sdf(sdf)

        before.around_cells(cells, extended, keep=keep)
        return moves[0]

    @property
    def is_identity(self) -> bool:
        """Whether both have the same blocks."""
        before, after = self.before.blocks, self.after.blocks
        return dr.width(before) == dr.width(after) and bool(dr.all(before == after)[0])

    @cached_property
    def _sources(self) -> tuple[UInt32, UInt32]:
        """The old vertex that each new one takes its value from, and how many cells away it is."""
        source = self.after.find_in(self.before)
        uint_t = type(source)
        distance = dr.zeros(uint_t, dr.width(source))
        dr.eval(source, distance)
        unknown = dr.compress(source == MISSING)
        step = 0
        while dr.width(unknown):
            step += 1
            found = dr.full(uint_t, MISSING, dr.width(unknown))
            for axis in range(3):
                for up in (False, True):
                    neighbour = self.after.neighbour(unknown, uint_t(axis), dr.mask_t(uint_t)(up))
                    exists = neighbour != MISSING
                    origin = dr.gather(uint_t, source, neighbour, exists)
                    found = dr.minimum(found, dr.select(exists, origin, MISSING))
            dr.eval(found)
            reached = found != MISSING
            if not dr.any(reached)[0]:
                found, reached = dr.zeros(uint_t, dr.width(unknown)), True
            dr.scatter(source, found, unknown, reached)
            dr.scatter(distance, dr.opaque(uint_t, step), unknown, reached)
            dr.eval(source, distance)
            unknown = dr.compress(source == MISSING)
        return source, distance

    def values(self, field: Float) -> Float:
        """A flat field with any number of channels per stored vertex."""
        return self._gather(field, True)

    def moments(self, field: Float) -> Float:
        """The same for what an optimiser remembers: new vertices have no past."""
        return self._gather(field, self._sources[1] == 0)

    def sdf(self, field: Float) -> Float:
        """A signed distance in lattice units."""
        float_t = type(field)
        source, distance = self._sources
        field = dr.detach(field)
        value = dr.gather(float_t, field, source)
        size = dr.abs(value) + dr.opaque(float_t, self.before.spacing) * float_t(distance)
        outward = dr.select(is_set(self.before.signs(field), source), -size, size)
        return dr.select(distance == 0, value, outward)

    def optimizer(self, optimizer: mi.ad.Adam, names: Iterable[str]) -> None:
        """Carries parameters of an ``mi.ad.Adam`` and its moments along.

        Args:
            names: the parameters that live on the blocks; ``sdf`` is taken for a signed distance.
        """
        for name in names:
            value, promoted, rate, (step, first, second, largest) = optimizer.state[name]
            carried = self.sdf(value) if name == "sdf" else self.values(dr.detach(value))
            dr.make_opaque(carried)
            dr.enable_grad(carried)
            first, second = self.moments(first), self.moments(second)
            largest = None if largest is None else self.moments(largest)
            dr.eval(first, second, largest)
            optimizer.state[name] = carried, promoted, rate, (step, first, second, largest)

    def _gather(self, field: Float, stays: Bool | Literal[True]) -> Float:
        source = self._sources[0]
        uint_t = type(source)
        channels = dr.width(field) // self.before.vertex_count
        if channels == 1:
            return dr.gather(type(field), field, source, stays)
        index = dr.arange(uint_t, channels * self.after.vertex_count)
        vertex = index // channels
        origin = dr.gather(uint_t, source, vertex) * channels + (index - vertex * channels)
        if stays is not True:
            stays = dr.gather(dr.mask_t(uint_t), stays, vertex)
        return dr.gather(type(field), field, origin, stays)
