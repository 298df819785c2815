"""Lattice fields between the vertices."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..lattice import Lattice


class Interpolation:
    """Trilinear interpolation of a field on a whole lattice; constant beyond it.

    Args:
        field: one value, or several interleaved channels, per lattice vertex.
        lattice: its lattice.
    """

    def __init__(self, field: mi.Float, lattice: Lattice):
        n = lattice.stride
        self._lattice = lattice
        self._channels = dr.width(field) // lattice.vertex_count
        # Without the texture units of a GPU, whose weights have 8 bits.
        self._texture = mi.Texture3f(mi.TensorXf(field, (n, n, n, self._channels)), use_accel=False,
                                     wrap_mode=dr.WrapMode.Clamp)

    def __call__(self, points: mi.Point3f) -> mi.Float:
        """The values at points in lattice units, channels interleaved."""
        return dr.ravel(mi.ArrayXf(self.channels(points)))

    def channels(self, points: mi.Point3f) -> list[mi.Float]:
        """The same, one array per channel."""
        cells = (mi.Point3f(points) + 1) / self._lattice.spacing
        return self._texture.eval((cells + 0.5) / self._lattice.stride)
