"""Base colour finer than the lattice: voxels around the surface, read where a path hits.

Colours at the lattice's vertices cannot be finer than its cells. What is finer in the images is residual
then, and geometry is blamed for it. So the colour is a sum of two: that of the vertices, which is smooth,
moves with the lattice and is known where hardly a pixel looks, and a detail in voxels as small as pixels.
"""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

from .activations import sigmoid
from .bricks import BRICK, Bricks

#: Colours of vertices nearer to 0 or 1 than this have no logit.
_SATURATED = 1e-3

#: Bricks reach at least this far from the surface, in voxels.
_MARGIN = 3


class ColorDetail:
    """What is added to the logits of the base colour, in sparse voxels around a surface.

    Args:
        vertices: (V, 3) of the surface in the cube [-1, 1]^3, closer together than a few voxels.
        side: voxels per side of the cube, a multiple of 4.
        to_lattice: from the world to the cube.

    Attributes:
        values: ``mi.Float``, four numbers per voxel: red, green, blue and nothing.
    """

    def __init__(self, vertices: np.ndarray, side: int, to_lattice: mi.Transform4f):
        self.to_lattice = to_lattice
        self._use(_bricks_around(vertices, side))
        self.values = dr.zeros(mi.Float, 4 * self.bricks.voxel_count)

    def arrays(self) -> dict[str, np.ndarray]:
        """What ``restore`` needs, as host arrays."""
        return {"detail_places": self.bricks.places.astype(np.int32), "detail_values": self.values.numpy()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Puts back what ``arrays`` gave."""
        self._use(Bricks.at(arrays["detail_places"], self.bricks.side))
        self.values = mi.Float(arrays["detail_values"])

    def _use(self, bricks: Bricks) -> None:
        self.bricks, self._lookup = bricks, bricks.lookup()
        dr.eval(self._lookup.side, self._lookup.bricks)

    def at(self, point: mi.Point3f, active: mi.Bool | bool = True) -> mi.Color3f:
        """The detail at world positions."""
        total = mi.Vector4f(0)
        for voxel, weight in self._lookup.around(self.to_lattice @ point, mi.Bool(active)):
            total += weight * dr.gather(mi.Vector4f, self.values, voxel, active & (weight > 0))
        return mi.Color3f(total.x, total.y, total.z)

    def color(self, color: mi.Color3f, point: mi.Point3f, active: mi.Bool | bool = True) -> mi.Color3f:
        """The base colour at world positions, given that of the lattice."""
        color = dr.clip(color, _SATURATED, 1 - _SATURATED)
        return sigmoid(dr.log(color / (1 - color)) + self.at(point, active))

    def follow(self, vertices: np.ndarray) -> mi.UInt32:
        """Moves the bricks to where a surface is now.

        Returns:
            For each new voxel the old one, or the number of old ones where it is new: what an optimiser's
            state is moved by.
        """
        old, count = self._lookup, self.bricks.voxel_count
        self._use(_bricks_around(vertices, self.bricks.side))
        place = mi.Vector3i((self.bricks.centres() + 1) * (0.5 * mi.Float(old.side)))
        voxel = old.voxel(place.x, place.y, place.z, mi.Bool(True))
        source = mi.UInt32(dr.select(voxel < 0, dr.opaque(mi.Int32, count), voxel))
        self.values = moved(self.values, source)
        return source


def moved(values: mi.Float, source: mi.UInt32) -> mi.Float:
    """Four numbers per voxel, taken from other voxels; 0 where the source is beyond the last."""
    exists = source < dr.opaque(mi.UInt32, dr.width(values) // 4)
    taken = dr.ravel(dr.gather(mi.Vector4f, values, source, exists))
    dr.eval(taken)
    return taken


def _bricks_around(vertices: np.ndarray, side: int) -> Bricks:
    m = side // BRICK
    live = np.zeros((m, m, m), bool)
    scaled = (vertices + 1) * (side / 2)
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (((scaled + _MARGIN * (2 * np.array(corner) - 1)) // BRICK).astype(int).clip(0, m - 1)).T
        live[z, y, x] = True
    return Bricks.where(live)
