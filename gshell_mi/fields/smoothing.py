"""Diffusion of lattice fields: Sobolev gradients, and the extension of values known on a surface only."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class LatticeDiffusion:
    """Approximates ``(I + smoothing L)^-1`` with the lattice's 6-neighbour Laplacian L.

    Damped Jacobi iterations: they reach no farther than ``iterations`` cells, which is all that a
    preconditioner needs, and each is one small kernel. There is no flow through the boundary, so a
    constant field stays as it is.

    Args:
        stride: lattice vertices per side; fields have ``stride**3`` values, x fastest.
        iterations: Jacobi iterations.
    """

    def __init__(self, stride: int, iterations: int = 12):
        self.iterations = iterations
        index = dr.arange(mi.UInt32, stride**3)
        n = dr.opaque(mi.UInt32, stride)
        row = index // n
        z = row // n
        x, y = index - row * n, row - z * n
        # A missing neighbour is the vertex itself.
        self._neighbours = []
        for coordinate, step in ((x, dr.opaque(mi.UInt32, 1)), (y, n), (z, n * n)):
            self._neighbours.append(dr.select(coordinate > 0, index - step, index))
            self._neighbours.append(dr.select(coordinate + 1 < n, index + step, index))
        dr.eval(self._neighbours)
        self._count = stride**3

    def __call__(self, field: mi.Float, smoothing: float) -> mi.Float:
        """Diffuses a flat field of one value, or of interleaved channels, per lattice vertex.

        Args:
            field: ``Float`` with ``channels * stride**3`` values, (r0, g0, b0, r1, ...) for three.
            smoothing: lambda; 0 returns the field as it is.
        """
        if smoothing == 0:
            return field
        if dr.width(field) == 3 * self._count:
            channels = dr.unravel(mi.Vector3f, field)
            return dr.ravel(mi.Vector3f(*(self(channel, smoothing) for channel in channels)))
        weight = dr.opaque(mi.Float, smoothing)
        solution = field
        for _ in range(self.iterations):
            total = sum(dr.gather(mi.Float, solution, neighbour) for neighbour in self._neighbours)
            solution = (field + weight * total) / (1 + 6 * weight)
            dr.eval(solution)
        return solution

    def extend(self, values: mi.Float, weights: mi.Float, smoothing: float = 2.0) -> tuple[mi.Float, mi.Bool]:
        """Spreads values that are known at some vertices to their surroundings (normalised convolution).

        Args:
            values: the sum of the weighted values at each lattice vertex, one or three channels.
            weights: the sum of the weights, one channel; 0 where nothing is known.

        Returns:
            The values, 0 where there are none, and a mask of the vertices that have one. Vertices
            that were known before keep their value.
        """
        channels = dr.width(values) // self._count
        norm = self(weights, smoothing)
        # Known vertices keep what they know, the others take the mean of what reaches them.
        original, reached = weights > 0, norm > 1e-12
        vertex = dr.arange(mi.UInt32, channels * self._count) // channels
        original_here, reached_here = (dr.gather(mi.Bool, mask, vertex) for mask in (original, reached))
        divisor = dr.gather(mi.Float, dr.select(original, weights, norm), vertex)
        total = dr.select(original_here, values, self(values, smoothing))
        known = original | reached
        return dr.select(original_here | reached_here, total / divisor, 0), known
