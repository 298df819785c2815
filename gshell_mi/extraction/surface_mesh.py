"""The extracted mesh, and how its vertices hang on the lattice."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import numpy as np
import trimesh

from ..arrays import AnyArray, Array3f, Array3u, ArrayT, Float, UInt32
from ..errors import UserError
from ..lattice import array_type


@dataclass(frozen=True)
class EdgePoints:
    """Points on lattice edges: the point ``(1 - t) a + t b`` of the edge from vertex ``a`` to ``b``."""

    a: UInt32  # vertex ids
    b: UInt32
    t: Float  # in (0, 1), attached to the signed distance field

    @property
    def count(self) -> int:
        return dr.width(self.a)

    def apply(self, fetch: Callable[[UInt32], ArrayT]) -> ArrayT:
        return _lerp(fetch(self.a), fetch(self.b), self.t)

    def interpolate(self, field: ArrayT) -> ArrayT:
        return self.apply(lambda vertex: gather(type(field), field, vertex))

    def entries(self) -> list[tuple[UInt32, UInt32, Float]]:
        """The interpolation as a sparse matrix: (point, lattice vertex, weight), entry by entry."""
        point = dr.arange(type(self.a), self.count)
        return [(point, self.a, 1 - self.t), (point, self.b, self.t)]

    def at(self, index: UInt32) -> "EdgePoints":
        a, b = (dr.gather(type(index), x, index) for x in (self.a, self.b))
        return EdgePoints(a, b, gather(type(self.t), self.t, index))


@dataclass(frozen=True)
class DualPoints:
    """Weighted means of up to eight points on lattice edges, in eight slots per mean."""

    edges: EdgePoints
    """The points, eight per mean."""
    weight: Float
    """Their weights, which sum to 1 for each mean; 0 in unused slots."""

    @property
    def count(self) -> int:
        return dr.width(self.weight) // 8

    def apply(self, fetch: Callable[[UInt32], ArrayT]) -> ArrayT:
        return dr.block_sum(self.weight * self.edges.apply(fetch), 8)

    def interpolate(self, field: ArrayT) -> ArrayT:
        return self.apply(lambda vertex: gather(type(field), field, vertex))

    def entries(self) -> list[tuple[UInt32, UInt32, Float]]:
        return [(slot >> 3, vertex, self.weight * share) for slot, vertex, share in self.edges.entries()]

    def at(self, index: UInt32) -> "DualPoints":
        slot = dr.arange(type(index), 8 * dr.width(index))
        source = dr.gather(type(index), index, slot >> 3) << 3 | slot & 7
        return DualPoints(self.edges.at(source), gather(type(self.weight), self.weight, source))


@dataclass(frozen=True)
class CutPoints:
    """Points on the segment between two other points: ``(1 - t) start + t end``."""

    start: EdgePoints | DualPoints
    end: EdgePoints | DualPoints
    t: Float  # in (0, 1), attached to both fields

    @property
    def count(self) -> int:
        return self.start.count

    def apply(self, fetch: Callable[[UInt32], ArrayT]) -> ArrayT:
        return _lerp(self.start.apply(fetch), self.end.apply(fetch), self.t)

    def entries(self) -> list[tuple[UInt32, UInt32, Float]]:
        return [
            (point, vertex, weight * gather(type(share), share, point))
            for points, share in ((self.start, 1 - self.t), (self.end, self.t))
            for point, vertex, weight in points.entries()
        ]


Points: TypeAlias = EdgePoints | DualPoints | CutPoints
"""Points on the lattice of any kind."""


@dataclass(frozen=True)
class Stencil:
    """How mesh vertices interpolate the lattice: blocks of points, one after the other."""

    blocks: tuple[Points, ...]

    @property
    def count(self) -> int:
        return sum(block.count for block in self.blocks)

    def apply(self, fetch: Callable[[UInt32], ArrayT]) -> ArrayT:
        """The values at the mesh vertices of what ``fetch`` returns for lattice vertex ids."""
        return concatenate([block.apply(fetch) for block in self.blocks])

    def entries(self) -> list[tuple[UInt32, UInt32, Float]]:
        """The interpolation as a sparse matrix: arrays of (mesh vertex, lattice vertex, weight)."""
        first, result = 0, []
        for block in self.blocks:
            for point, vertex, weight in block.entries():
                result.append((point + dr.opaque(type(point), first), vertex, weight))
            first += block.count
        return result


@dataclass(frozen=True)
class SurfaceMesh:
    """A triangle mesh extracted from lattice fields, differentiable in them.

    The faces are oriented: anticlockwise seen from outside the template. No vertex is unused, and no face is
    there twice; the mesh is an edge- and vertex-manifold whose boundary vertices have two boundary edges.
    """

    vertices: Array3f
    """Positions, Dr.Jit ``Array3f``, in lattice units ([-1, 1]^3)."""
    faces: Array3u
    """Vertex indices, Dr.Jit ``Array3u``."""
    msdf: Float
    """mSDF at the vertices, ``Float``: >= 0 on an open surface, 0 where it was cut."""
    lattice_vertex_count: int
    """Values that a field given to ``interpolate`` must have."""
    stencil: Stencil | None
    """Weights of the vertices on the lattice; None if the mesh is empty."""
    template: "SurfaceMesh | None" = None
    """The watertight surface that this one was cut from, if it was asked for. Its first
    ``kept_vertex_count`` vertices are the first ones of this mesh."""
    kept_vertex_count: int = 0
    """Vertices of the template that stay; the vertices after them lie on the cut."""
    cells: UInt32 | None = None
    """Lowest lattice vertices of the cells that the template passes through, and few others; ascending."""

    @property
    def vertex_count(self) -> int:
        return dr.width(self.vertices)

    @property
    def face_count(self) -> int:
        return dr.width(self.faces)

    @property
    def is_empty(self) -> bool:
        return self.face_count == 0

    def interpolate(self, field: AnyArray, channels: int = 1) -> AnyArray:
        """Interpolates any lattice field at the vertices with the weights that made their positions.

        Args:
            field: one value per lattice vertex, ``Float`` or ``ArrayNf`` (N channels); or a flat
                ``Float`` of ``channels`` consecutive values per lattice vertex.
            channels: 1 to 4, for flat fields.

        Returns:
            One value per mesh vertex: the field's type, or ``ArrayNf`` with N = ``channels`` > 1.
            Differentiable in ``field``, and in ``sdf`` and ``msdf`` through the weights.

        Raises:
            UserError: the field has another number of values than the lattice has vertices.
        """
        needed = self.lattice_vertex_count * channels
        if dr.width(field) != needed:
            raise UserError(
                f"a field to interpolate has {dr.width(field)} values, but the lattice needs {needed}"
            )
        kind = type(field) if channels == 1 else array_type(type(field), f"Array{channels}f")
        if self.stencil is None:
            return dr.zeros(kind, 0)
        return self.stencil.apply(lambda vertex: gather(kind, field, vertex))

    def vertex_normals(self) -> Array3f:
        """Unit normals at the vertices, weighted by area; ``Array3f``, differentiable."""
        kind = type(self.vertices)
        if self.is_empty:
            return dr.zeros(kind, 0)
        p0, p1, p2 = (gather(kind, self.vertices, index) for index in self.faces)
        weighted = dr.cross(p1 - p0, p2 - p0)
        normals = dr.zeros(kind, self.vertex_count)
        for index in self.faces:
            dr.scatter_reduce(dr.ReduceOp.Add, normals, weighted, index, mode=dr.ReduceMode.Local)
        # Opposite faces may cancel out: leave 0 then, not NaN.
        return normals * dr.rsqrt(dr.maximum(dr.squared_norm(normals), 1e-30))

    def to_numpy(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (V, 3) float32, faces (F, 3) int64 and mSDF (V,) float32 on the host."""
        if self.is_empty:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64), np.zeros(0, np.float32)
        detached = dr.detach((self.vertices, self.msdf))
        return (
            np.array(detached[0].numpy().T, order="C"),
            np.array(self.faces.numpy().T, np.int64, order="C"),
            detached[1].numpy(),
        )

    def to_trimesh(self) -> trimesh.Trimesh:
        """A detached copy for trimesh, with ``msdf`` among its vertex attributes."""
        vertices, faces, msdf = self.to_numpy()
        return trimesh.Trimesh(vertices, faces, vertex_attributes={"msdf": msdf}, process=False)


def gather(kind: type[ArrayT], source: AnyArray, index: UInt32) -> ArrayT:
    """``dr.gather`` whose adjoint is the same kernel for every size of ``source``.

    The default strategy for the adjoint of small arrays (``dr.ReduceMode.Expand``) writes their size into
    the kernel.
    """
    return dr.gather(kind, source, index, mode=dr.ReduceMode.Local)


def _lerp(start: ArrayT, end: ArrayT, t: Float) -> ArrayT:
    # Not start + t (end - start), whose difference may overflow.
    return (1 - t) * start + t * end


def concatenate(values: Sequence[ArrayT]) -> ArrayT:
    """``dr.concat`` for Dr.Jit arrays of changing sizes: no size ends up in a kernel's code."""
    if len(values) == 1:
        return values[0]
    total = sum(dr.width(v) for v in values)
    kind = type(values[0])
    uint32_t = dr.uint32_array_t(dr.leaf_t(kind))
    result = dr.empty(kind, total)
    offset = 0
    for value in values:
        index = dr.arange(uint32_t, dr.width(value)) + dr.opaque(uint32_t, offset)
        dr.scatter(result, value, index, mode=dr.ReduceMode.Permute)
        offset += dr.width(value)
    return result
