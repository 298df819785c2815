"""Diffusion on lattices and meshes: Sobolev gradients, and values extended from a surface to the lattice."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from itertools import islice

import drjit as dr
import mitsuba as mi
import numpy as np
from cholespy import CholeskySolverF, MatrixType
from scipy.sparse import coo_matrix, csr_matrix, eye
from scipy.sparse.csgraph import laplacian

from ..lattice import MISSING, BlockLattice, Lattice
from ..lattice.block_lattice import MARGIN
from ..lattice.sign_scan import vertices_near
from ..topology import mesh_edges

#: Vertices of blocks, at most, whose neighbours are kept, in 24 bytes each: it takes half the time.
_NEIGHBOURS_KEPT = 1 << 22

#: Cells between given cells and the edge of what is diffused around them, as around a surface in blocks.
NEAR = MARGIN


class LatticeDiffusion:
    """Approximates ``(I + smoothing L)^-1`` with the Laplacian L of the lattice's nearest neighbours.

    These are six in a cubic grid and eight in a body-centred one; either L is about ``-cell^2`` times that of
    space.

    Damped Jacobi iterations: they reach no farther than ``iterations`` cells, which is all that a
    preconditioner needs, and each is one small kernel. There is no flow through the boundary, so a
    constant field stays as it is. The edge of the blocks of a ``BlockLattice`` is such a boundary, and so is
    that of the surroundings of given ``cells``: what would have passed it stays inside.

    Args:
        lattice: the fields have one value, or several channels, per vertex of it.
        iterations: Jacobi iterations.
        cells: if given, ids of the lowest vertices of cells, as in ``SurfaceMesh.cells``: only the vertices
            within ``NEAR`` cells of them are diffused, and all others keep their values. A gradient of a
            surface is little else than 0 there. Blocks are such surroundings already and are diffused whole.
    """

    def __init__(self, lattice: Lattice | BlockLattice, iterations: int = 12, cells: mi.UInt32 | None = None):
        self.iterations = iterations
        self._lattice = lattice
        self._count = lattice.vertex_count
        self._vertices = None
        if cells is not None and isinstance(lattice, Lattice):
            self._vertices = vertices_near(cells, lattice, NEAR)

    @cached_property
    def _neighbours(self) -> list[mi.UInt32] | None:
        """The neighbours of each vertex, if they are kept; a missing one is the vertex itself."""
        if isinstance(self._lattice, BlockLattice) and self._count > _NEIGHBOURS_KEPT:
            return None
        if self._vertices is None:
            found = self._lattice.neighbours(dr.arange(mi.UInt32, self._count))
        else:
            here = dr.arange(mi.UInt32, dr.width(self._vertices))
            rank = dr.full(mi.UInt32, MISSING, self._count)
            dr.scatter(rank, here, self._vertices, mode=dr.ReduceMode.Permute)
            around = self._lattice.neighbours(self._vertices)
            ranks = (dr.gather(mi.UInt32, rank, vertex) for vertex in around)
            found = [dr.select(neighbour == MISSING, here, neighbour) for neighbour in ranks]
        dr.eval(found)
        return found

    def __call__(self, field: mi.Float, smoothing: float) -> mi.Float:
        """Diffuses a flat field of one value, or of interleaved channels, per lattice vertex.

        Args:
            field: ``Float`` with one value per vertex, or three: (r0, g0, b0, r1, ...).
            smoothing: lambda; 0 returns the field as it is.
        """
        return self.together({"": field}, smoothing)[""]

    def together(self, fields: Mapping[str, mi.Float], smoothing: float) -> dict[str, mi.Float]:
        """The same of several fields at once, which is faster than one after the other."""
        if smoothing == 0 or (self._vertices is not None and dr.width(self._vertices) == 0):
            return dict(fields)
        # What is still to be added to them, as to gradients, cannot wait for the kernel that packs them.
        dr.eval(list(fields.values()))
        columns = [column for field in fields.values() for column in self._columns(field)]
        diffused = []
        # Four values that lie side by side are gathered in twice the time of one, three in five times.
        for first in range(0, len(columns), 4):
            group = columns[first : first + 4]
            kind = (mi.Float, mi.Vector2f, mi.Vector4f, mi.Vector4f)[len(group) - 1]
            padding = [mi.Float(0)] if len(group) == 3 else []
            solution = self._diffused(kind, dr.ravel(kind(*group, *padding)), smoothing)
            diffused += [solution] if kind is mi.Float else list(dr.unravel(kind, solution))[: len(group)]
        found = iter(diffused)
        return {name: self._with_columns(field, found) for name, field in fields.items()}

    def _columns(self, field: mi.Float) -> list[mi.Float]:
        """The channels of a field at the vertices that are diffused."""
        kind = self._kind(field)
        values = dr.unravel(kind, field) if self._vertices is None else dr.gather(kind, field, self._vertices)
        return [values] if kind is mi.Float else list(values)

    def _with_columns(self, field: mi.Float, columns: Iterator[mi.Float]) -> mi.Float:
        """A field whose channels are the next of ``columns`` at the vertices that are diffused."""
        kind = self._kind(field)
        values = next(columns) if kind is mi.Float else kind(*islice(columns, 3))
        if self._vertices is None:
            return dr.ravel(values)
        whole = mi.Float(field)
        dr.scatter(whole, values, self._vertices, mode=dr.ReduceMode.Permute)
        return whole

    def _kind(self, field: mi.Float) -> type:
        return mi.Vector3f if dr.width(field) == 3 * self._count else mi.Float

    def _diffused(self, kind: type, field: mi.Float, smoothing: float) -> mi.Float:
        known, weight = dr.unravel(kind, field), dr.opaque(mi.Float, smoothing)
        solution = field
        for _ in range(self.iterations):
            # Of many blocks found anew each time: the tables of rows are small, all neighbours are not.
            neighbours = self._neighbours or self._lattice.neighbours(dr.arange(mi.UInt32, self._count))
            total = sum(dr.gather(kind, solution, neighbour) for neighbour in neighbours)
            solution = dr.ravel((known + weight * total) / (1 + len(neighbours) * weight))
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
        spread = self.together({"values": values, "weights": weights}, smoothing)
        norm = spread["weights"]
        # Known vertices keep what they know, the others take the mean of what reaches them.
        original, reached = weights > 0, norm > 1e-12
        vertex = dr.arange(mi.UInt32, channels * self._count) // channels
        original_here, reached_here = (dr.gather(mi.Bool, mask, vertex) for mask in (original, reached))
        divisor = dr.gather(mi.Float, dr.select(original, weights, norm), vertex)
        total = dr.select(original_here, values, spread["values"])
        known = original | reached
        return dr.select(original_here | reached_here, total / divisor, 0), known


def mesh_laplacian(faces: np.ndarray, vertex_count: int) -> csr_matrix:
    """(V, V) combinatorial Laplacian of a mesh: how many neighbours a vertex has, less one for each of them.

    >>> mesh_laplacian(np.array([[0, 1, 2]]), 3).toarray().tolist()
    [[2.0, -1.0, -1.0], [-1.0, 2.0, -1.0], [-1.0, -1.0, 2.0]]
    """
    start, end = mesh_edges(faces)[0].T
    adjacency = coo_matrix((np.ones(len(start)), (start, end)), shape=(vertex_count, vertex_count))
    return laplacian(adjacency + adjacency.T).tocsr()


class MeshDiffusion:
    """Solves ``(I + smoothing L) x = b`` with the combinatorial Laplacian L of a mesh (Nicolet et al. 2021).

    Exact, by a sparse Cholesky factorisation that is made once. A few iterations would be faster, but what
    is far from all that a view sees would get nothing, or a wrong sign, and Adam makes full steps of either:
    the cap of a T-shirt's hem, which few views see, did not open then.

    Args:
        faces: (F, 3) vertex indices.
        vertex_count: V.
        smoothing: lambda; features of about sqrt(lambda) edges remain.

    Attributes:
        count: vertices.
    """

    def __init__(self, faces: np.ndarray, vertex_count: int, smoothing: float):
        system = (eye(vertex_count) + smoothing * mesh_laplacian(faces, vertex_count)).tocoo()
        self.count = vertex_count
        # Dr.Jit's arrays tell where to solve: on the CPU or the GPU.
        self._solver = CholeskySolverF(
            vertex_count, mi.Int32(system.row), mi.Int32(system.col), mi.Float64(system.data), MatrixType.COO
        )

    def __call__(self, values: mi.Float) -> mi.Float:
        """Diffuses a flat field of one value, or of interleaved channels, per vertex."""
        return self.together({"": values})[""]

    def together(self, fields: Mapping[str, mi.Float]) -> dict[str, mi.Float]:
        """The same of several fields at once: four columns are solved for in the time of one."""
        if not fields:
            return {}
        channels = {name: dr.width(field) // self.count for name, field in fields.items()}
        vertex = dr.arange(mi.UInt32, self.count)
        columns = [
            dr.gather(mi.Float, field, vertex * channels[name] + channel)
            for name, field in fields.items()
            for channel in range(channels[name])
        ]
        shape = (self.count, len(columns))
        solution = dr.empty(mi.TensorXf, shape=shape)
        self._solver.solve(mi.TensorXf(dr.ravel(mi.ArrayXf(columns), order="F"), shape), solution)
        diffused, first = {}, 0
        for name, count in channels.items():
            index = dr.arange(mi.UInt32, self.count * count)
            place = index // count * len(columns) + first + index % count
            diffused[name] = dr.gather(mi.Float, solution.array, place)
            first += count
        return diffused
