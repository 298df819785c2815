"""Lattice fields between the vertices."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..lattice import BccLattice, Lattice


class Interpolation:
    """Interpolation of a field on a whole lattice, trilinear in cubes; constant beyond it.

    In a body-centred cubic lattice the field is linear in each tetrahedron.

    Args:
        field: one value, or several interleaved channels, per lattice vertex.
        lattice: its lattice.
    """

    def __init__(self, field: mi.Float, lattice: Lattice):
        channels = dr.width(field) // lattice.vertex_count
        self._within = (
            _InTetrahedra(field, lattice, channels)
            if isinstance(lattice, BccLattice)
            else _InCubes(field, lattice, channels)
        )

    def __call__(self, points: mi.Point3f) -> mi.Float:
        """The values at points in lattice units, channels interleaved."""
        return dr.ravel(mi.ArrayXf(self.channels(points)))

    def channels(self, points: mi.Point3f) -> list[mi.Float]:
        """The same, one array per channel."""
        return self._within.channels(mi.Point3f(points))


class _InCubes:
    def __init__(self, field: mi.Float, lattice: Lattice, channels: int):
        (self._grid,) = lattice.grids
        n = self._grid.stride
        # Without the texture units of a GPU, whose weights have 8 bits.
        self._texture = mi.Texture3f(
            mi.TensorXf(field, (n, n, n, channels)), use_accel=False, wrap_mode=dr.WrapMode.Clamp
        )

    def channels(self, points: mi.Point3f) -> list[mi.Float]:
        cells = (points - self._grid.origin) / self._grid.spacing
        return self._texture.eval((cells + 0.5) / self._grid.stride)


class _InTetrahedra:
    def __init__(self, field: mi.Float, lattice: BccLattice, channels: int):
        self._field, self._lattice, self._channels = field, lattice, channels

    def channels(self, points: mi.Point3f) -> list[mi.Float]:
        lattice = self._lattice
        # In half cells, within the first grid and half a cell away from the border: all corners exist there.
        q = dr.clip((points + 1) * (2 / lattice.spacing), 1, 2 * lattice.resolution)
        # Coordinates along the basis; the order of their fractions tells the tetrahedron of a cell.
        along = 0.5 * mi.Point3f(q.y + q.z, q.z + q.x, q.x + q.y)
        lowest = dr.floor(along)
        fractions = list(along - lowest)
        base = mi.Vector3i(lowest)
        rank = [
            sum(
                dr.select((other > own) | ((other == own) & (j < i)), mi.UInt32(1), 0)
                for j, other in enumerate(fractions)
                if j != i
            )
            for i, own in enumerate(fractions)
        ]
        descending = [
            sum(dr.select(rank[i] == place, fractions[i], 0) for i in range(3)) for place in range(3)
        ]
        weights = [
            1 - descending[0],
            descending[0] - descending[1],
            descending[1] - descending[2],
            descending[2],
        ]
        total = [mi.Float(0) for _ in range(self._channels)]
        for step, weight in enumerate(weights):
            i, j, k = (base[axis] + dr.select(rank[axis] < step, mi.Int32(1), 0) for axis in range(3))
            vertex = self._vertex(j + k - i, k + i - j, i + j - k)
            for channel in range(self._channels):
                total[channel] += weight * dr.gather(mi.Float, self._field, self._channels * vertex + channel)
        return total

    def _vertex(self, x: mi.Int32, y: mi.Int32, z: mi.Int32) -> mi.UInt32:
        """The id of the vertex at a place in half cells, or of one beside it where the lattice has ended."""
        stride = self._lattice.stride
        second = (x & 1) == 1
        x, y, z = (mi.UInt32(dr.clip(number >> 1, 0, stride - 1)) for number in (x, y, z))
        return x + stride * (y + stride * z) + dr.select(second, mi.UInt32(stride**3), 0)
