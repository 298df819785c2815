"""Sparse voxels in bricks of 4 x 4 x 4, with the distance to the next brick where there is none."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

#: Voxels per side of a brick, and their binary logarithm.
BRICK, _SHIFT = 4, 2

_VOXELS = BRICK**3


@dataclass(frozen=True)
class Bricks:
    """Which bricks of a cube of voxels exist, and where their voxels are stored.

    Voxels fill the cube [-1, 1]^3; the centre of voxel (i, j, k) is at ((i, j, k) + 0.5) * 2 / side - 1. The
    voxels of brick ``b`` have the indices 64 b to 64 b + 63, x fastest.

    Attributes:
        side: voxels per side of the cube, a multiple of 4.
        places: (B, 3) integers, x, y, z of each brick in bricks.
        slots: per brick of the cube, x fastest, its index, or minus the distance (Chebyshev, in bricks) to
            the next brick that exists.
    """

    side: int
    places: np.ndarray
    slots: mi.Int32

    @classmethod
    def where(cls, live: np.ndarray) -> Bricks:
        """The bricks that are ``live``, an (m, m, m) array of booleans, z by y by x; one at least."""
        live = live if live.any() else np.ones_like(live)
        slots = -ndimage.distance_transform_cdt(~live, "chessboard").astype(np.int32)
        slots[live] = np.arange(np.count_nonzero(live))
        return cls(BRICK * len(live), np.argwhere(live)[:, ::-1], mi.Int32(slots.ravel()))

    @classmethod
    def at(cls, places: np.ndarray, side: int) -> Bricks:
        """The bricks at (B, 3) places, sorted by z, y and x."""
        live = np.zeros((side // BRICK,) * 3, bool)
        x, y, z = np.asarray(places, np.intp).T
        live[z, y, x] = True
        return cls.where(live)

    @property
    def voxel_count(self) -> int:
        return _VOXELS * len(self.places)

    def centres(self) -> mi.Point3f:
        """The voxels' centres in the cube [-1, 1]^3, in the order of their indices."""
        voxel = dr.arange(mi.UInt32, self.voxel_count)
        table = mi.UInt32(self.places.astype(np.uint32).ravel())
        corner = dr.gather(mi.Vector3u, table, voxel >> (3 * _SHIFT))
        inner = mi.Vector3u(voxel & 3, (voxel >> 2) & 3, (voxel >> 4) & 3)
        position = mi.Point3f(corner * BRICK + inner) + 0.5
        return position * dr.opaque(mi.Float, 2 / self.side) - 1

    def lookup(self) -> Lookup:
        """What kernels read the bricks by; sizes are no constants in them."""
        return Lookup(self.slots, dr.opaque(mi.Int32, self.side), dr.opaque(mi.Int32, self.side // BRICK))

    def dense(self, values: np.ndarray, outside: float = 0.0) -> np.ndarray:
        """(side, side, side) voxels, z by y by x, of one value each; ``outside`` where there is no brick."""
        m = self.side // BRICK
        cube = np.full((m, m, m, BRICK, BRICK, BRICK), outside, np.float32)
        x, y, z = self.places.T
        cube[z, y, x] = values.reshape(-1, BRICK, BRICK, BRICK)
        return cube.transpose(0, 3, 1, 4, 2, 5).reshape((self.side,) * 3)


@dataclass(frozen=True)
class Lookup:
    """The device's side of ``Bricks``."""

    slots: mi.Int32
    side: mi.Int32
    bricks: mi.Int32

    def voxel(self, x: mi.Int32, y: mi.Int32, z: mi.Int32, active: mi.Bool) -> mi.Int32:
        """Index of a voxel, or minus the distance in bricks to the next one that exists."""
        brick = (x >> _SHIFT) + self.bricks * ((y >> _SHIFT) + self.bricks * (z >> _SHIFT))
        slot = dr.gather(mi.Int32, self.slots, brick, active)
        inner = (x & 3) + 4 * ((y & 3) + 4 * (z & 3))
        return dr.select(slot < 0, slot, slot * _VOXELS + inner)

    def way_out(self, position: mi.Point3f, inverse: mi.Vector3f, distance: mi.Int32) -> mi.Float:
        """Length of the ray through empty space, in units of the cube.

        Args:
            position: in [-1, 1]^3, where there is no brick.
            inverse: one over the ray's direction.
            distance: to the next brick, in bricks, at least 1.
        """
        width = 2.0 * BRICK / mi.Float(self.side)
        margin = mi.Float(distance - 1) * width
        way = mi.Float(dr.inf)
        for p, i in zip(position, inverse, strict=True):
            low = dr.floor((p + 1) / width) * width - 1
            side = dr.select(i > 0, low + width + margin, low - margin)
            way = dr.minimum(way, (side - p) * i)
        return way

    def nearby(self, position: mi.Point3f, bits: mi.UInt32, active: mi.Bool) -> mi.Int32:
        """One of the eight voxels around a position in [-1, 1]^3, with the probability of its trilinear
        weight; the lowest two of the random bits are not used."""
        scale, last = 0.5 * mi.Float(self.side), self.side - 1
        uniform = (mi.Float((bits >> shift) & 0x3FF) / 1024 for shift in (2, 12, 22))
        x, y, z = (
            dr.clip(mi.Int32(dr.floor((p + 1) * scale - 0.5 + u)), 0, last)
            for p, u in zip(position, uniform, strict=True)
        )
        return self.voxel(x, y, z, active)

    def around(self, position: mi.Point3f, active: mi.Bool) -> list[tuple[mi.Int32, mi.Float]]:
        """The eight voxels around a position in [-1, 1]^3 and their trilinear weights; a weight of 0 and the
        index 0 where a voxel does not exist."""
        scaled = (position + 1) * (0.5 * mi.Float(self.side)) - 0.5
        corner = dr.floor(scaled)
        part, corner, last = scaled - corner, mi.Vector3i(corner), self.side - 1
        found = []
        for index in range(8):
            steps = index & 1, index >> 1 & 1, index >> 2
            place = (dr.clip(c + step, 0, last) for c, step in zip(corner, steps, strict=True))
            x, y, z = place
            voxel = self.voxel(x, y, z, active)
            weight = mi.Float(1)
            for p, step in zip(part, steps, strict=True):
                weight = weight * (p if step else 1 - p)
            found.append((dr.maximum(voxel, 0), dr.select(voxel < 0, 0, weight)))
        return found
