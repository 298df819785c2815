"""Regularisers of the signed distance field on the lattice."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from ..activations import softplus
from ..extraction.surface_mesh import gather
from ..lattice import MISSING, BlockLattice, Lattice
from ..means import mean_where


def sign_cross_entropy(sdf: mi.Float, lattice: Lattice | BlockLattice) -> mi.Float:
    """Mean over the crossed lattice edges (a, b) of ``H(σ(s_a), sign s_b) + H(σ(s_b), sign s_a)``.

    Binary cross-entropy H that pulls the signs of neighbours together: sign changes that nothing supports,
    floaters and inner walls above all, go away (Munkberg et al. 2022, equation 2). The edges are those along
    the axes.

    Args:
        sdf: one value per lattice vertex; in cells, so that a neighbour's value is about 1.
    """
    total, count = mi.Float(0), mi.Float(0)
    for here, there, exists in _axis_edges(sdf, lattice):
        crossed = exists & ((here < 0) != (there < 0))
        total += dr.sum(dr.select(crossed, _cross_entropy(here, there) + _cross_entropy(there, here), 0))
        count += dr.sum(dr.select(crossed, mi.Float(1), 0))
    return total / dr.maximum(count, 1)


def eikonal(sdf: mi.Float, lattice: Lattice | BlockLattice, reach: float = 3.0) -> mi.Float:
    """Mean of ``(|grad s| - 1)^2`` by forward differences, over the vertices near the surface.

    A distance has slope 1 (Gropp et al. 2020); a field that forgets this gets cliffs, which cannot move, and
    plateaus, from which floaters rise.

    Args:
        sdf: one value per lattice vertex, in cells.
        reach: vertices with ``|s|`` up to this count, in cells.

    >>> from gshell_mi.lattice import TetLattice
    >>> lattice = TetLattice(16)
    >>> plane = lattice.points(mi.Float).x / lattice.spacing
    >>> f"{eikonal(plane, lattice)[0]:.4f} {eikonal(3 * plane, lattice)[0]:.2f}"
    '0.0000 4.00'
    """
    squared_slope, interior = mi.Float(0), dr.full(mi.Bool, True, lattice.vertex_count)
    for here, there, exists in _axis_edges(sdf, lattice):
        squared_slope += dr.square(there - here)
        interior &= exists
    near = interior & (dr.abs(dr.detach(sdf)) <= reach)
    # The root has no derivative at 0, where a constant field would make it infinite.
    return mean_where(near, dr.square(dr.sqrt(dr.maximum(squared_slope, 1e-8)) - 1))


def _axis_edges(
    sdf: mi.Float, lattice: Lattice | BlockLattice
) -> Iterator[tuple[mi.Float, mi.Float, mi.Bool]]:
    """Per axis the values at each vertex and at its next neighbour, and whether that exists."""
    if isinstance(lattice, BlockLattice):
        vertex = dr.arange(mi.UInt32, lattice.vertex_count)
        for axis in range(3):
            neighbour = lattice.neighbour(vertex, mi.UInt32(axis), mi.Bool(True))
            exists = (neighbour != MISSING) & lattice.in_lattice(vertex)
            yield sdf, gather(mi.Float, sdf, dr.select(exists, neighbour, vertex)), exists
        return
    vertex, stride = dr.arange(mi.UInt32, lattice.vertex_count), dr.opaque(mi.UInt32, lattice.stride)
    steps = (dr.opaque(mi.UInt32, 1), stride, stride * stride)
    for coordinate, step in zip(lattice.coordinates(vertex), steps, strict=True):
        exists = coordinate + 1 < stride
        yield sdf, gather(mi.Float, sdf, dr.select(exists, vertex + step, vertex)), exists


def _cross_entropy(logit: mi.Float, other: mi.Float) -> mi.Float:
    """Of ``sigmoid(logit)`` against the sign of ``other``, 1 for outside: ``softplus(-+ logit)``."""
    return softplus(dr.select(other < 0, logit, -logit))
