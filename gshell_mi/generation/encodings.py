"""Ways to write a pair of fields as numbers, and back.

Compared in ``docs/generation.md``; ``pipelines/compare_encodings.py`` makes the table.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

from ..errors import UserError
from .fields import TruncatedFields, lattice_edges

#: Vertices per side of a block.
BLOCK = 8
#: Values of a block: two fields.
BLOCK_VALUES = 2 * BLOCK**3

#: The signed distance in blocks that are not stored: so small that an edge from a stored vertex crosses the
#: surface, if it has to, at the far end, where the mSDF cuts it away.
_FILLED = 0.01
#: A coefficient of a crossing keeps so far from the ends of its edge.
_END = 1e-3
#: Magnitudes of neighbours differ by no more than this factor's logarithm, by which noise is kept in bounds.
_DAMPING = 1e-3


class Encoding(Protocol):
    """A way to write fields as the numbers that a model learns."""

    def encode(self, fields: TruncatedFields) -> dict[str, np.ndarray]:
        """The numbers, by name."""
        ...

    def decode(self, code: dict[str, np.ndarray], side: int) -> TruncatedFields:
        """Fields of N^3 = ``side``^3 vertices with the same surface, nearly."""
        ...


class DenseEncoding:
    """``dense``: both truncated distances as they are, (2, N, N, N)."""

    def encode(self, fields: TruncatedFields) -> dict[str, np.ndarray]:
        return {"values": np.stack([fields.sdf, fields.msdf])}

    def decode(self, code: dict[str, np.ndarray], side: int) -> TruncatedFields:
        return TruncatedFields(*code["values"].reshape(2, side, side, side))


class CubicEncoding:
    """``cubic``: the tetrahedral lattice laid out on a cube, as in Liu et al. (2024), sec. 4.

    On the grid of (2 N)^3, the last layers empty, every even node is a vertex of the lattice and every other
    one the middle of exactly one edge of Kuhn's tetrahedra. Vertices hold the sign of the signed distance.
    Edges that cross the surface hold where they do, from -1 to 1, and the mSDF there; the others hold 0.
    Magnitudes are not kept: decoding solves for some that put the crossings where they belong.
    """

    def encode(self, fields: TruncatedFields) -> dict[str, np.ndarray]:
        n = fields.side
        values = np.zeros((2, 2 * n, 2 * n, 2 * n), np.float32)
        values[0, ::2, ::2, ::2] = np.where(fields.sdf < 0, -1, 1)
        values[1, ::2, ::2, ::2] = fields.msdf > 0
        sdf, msdf = fields.sdf.ravel(), fields.msdf.ravel()
        for offset, a, b in lattice_edges(n):
            crossing = (sdf[a] < 0) != (sdf[b] < 0)
            a, b = a[crossing], b[crossing]
            t = np.clip(sdf[a] / (sdf[a] - sdf[b]), _END, 1 - _END)
            node = _node(a, n, offset)
            values[0][node] = 2 * t - 1
            values[1][node] = (1 - t) * msdf[a] + t * msdf[b]
        return {"values": values}

    def decode(self, code: dict[str, np.ndarray], side: int) -> TruncatedFields:
        values, n = code["values"], side
        inside = (values[0, ::2, ::2, ::2] < 0).ravel()
        kept = (values[1, ::2, ::2, ::2] > 0.5).ravel()
        found = []
        for offset, a, b in lattice_edges(n):
            crossing = inside[a] != inside[b]
            a, b = a[crossing], b[crossing]
            node = _node(a, n, offset)
            found.append((a, b, np.clip((values[0][node] + 1) / 2, _END, 1 - _END), values[1][node]))
        a, b, t, msdf = (np.concatenate(parts) for parts in zip(*found, strict=True))
        sdf = np.where(inside, -1.0, 1.0)
        at_vertices = np.where(kept, 1.0, -1.0)
        if len(a):
            used, ends = np.unique([a, b], return_inverse=True)
            a, b = ends.reshape(2, -1)
            # |s_a| / |s_b| = t / (1 - t) is linear in logarithms, and counts most where it is moderate.
            row = np.arange(len(a))
            ratio = _solved(
                row, a, b, np.ones(len(a)), -np.ones(len(a)), np.log(t / (1 - t)), t * (1 - t), len(used)
            )
            sdf[used] *= np.clip(np.exp(np.clip(ratio - ratio.mean(), -8, 8)), 1e-3, 1e3)
            sdf /= max(1.0, np.abs(sdf).max())
            at_vertices[used] = _solved(row, a, b, 1 - t, t, msdf, np.ones(len(a)), len(used))
        shape = (n, n, n)
        return TruncatedFields(
            sdf.reshape(shape).astype(np.float32), at_vertices.reshape(shape).astype(np.float32)
        )


class BlockEncoding:
    """``blocks``: both truncated distances in the blocks of 8^3 vertices near the surface only.

    ``blocks`` are the numbers of those blocks, x fastest, ascending; ``values`` (B, 1024) what they hold, the
    signed distances first.
    """

    def encode(self, fields: TruncatedFields) -> dict[str, np.ndarray]:
        per_side = _blocks_per_side(fields.side)
        near = _near_surface(fields)
        active = _split(near[None], per_side).any(axis=1)
        values = _split(np.stack([fields.sdf, fields.msdf]), per_side)
        blocks = np.flatnonzero(active)
        return {"blocks": blocks, "values": values[blocks]}

    def decode(self, code: dict[str, np.ndarray], side: int) -> TruncatedFields:
        return from_blocks(code["blocks"], code["values"], side)


def from_blocks(blocks: np.ndarray, values: np.ndarray, side: int) -> TruncatedFields:
    """Fields of which only some blocks are known: elsewhere the nearest known sign goes on, and is cut away.

    Args:
        blocks: (B,) numbers of blocks, x fastest.
        values: (B, 1024).
    """
    per_side = _blocks_per_side(side)
    table = np.zeros((per_side**3, BLOCK_VALUES), np.float32)
    table[:, : BLOCK**3] = 1.0
    table[blocks] = values
    fields = table.reshape(*3 * (per_side,), 2, *3 * (BLOCK,)).transpose(3, 0, 4, 1, 5, 2, 6)
    sdf, msdf = fields.reshape(2, side, side, side)
    unknown = np.ones(per_side**3, bool)
    unknown[blocks] = False
    if unknown.all() or not unknown.any():
        return TruncatedFields(sdf, msdf)
    missing = np.kron(unknown.reshape(*3 * (per_side,)), np.ones(3 * (BLOCK,), bool))
    nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    sdf = np.where(missing, np.copysign(_FILLED, sdf[tuple(nearest)]), sdf).astype(np.float32)
    return TruncatedFields(sdf, np.where(missing, np.float32(-1), msdf))


ENCODINGS: dict[str, Encoding] = {
    "dense": DenseEncoding(),
    "cubic": CubicEncoding(),
    "blocks": BlockEncoding(),
}


def _blocks_per_side(side: int) -> int:
    if side % BLOCK:
        raise UserError(
            f"blocks of {BLOCK} vertices per side do not fill a grid of {side}; give a multiple of {BLOCK}"
        )
    return side // BLOCK


def _split(fields: np.ndarray, per_side: int) -> np.ndarray:
    """(F, N, N, N) as (blocks, F 8^3)."""
    shape = (len(fields), per_side, BLOCK, per_side, BLOCK, per_side, BLOCK)
    return fields.reshape(shape).transpose(1, 3, 5, 0, 2, 4, 6).reshape(per_side**3, -1)


def _near_surface(fields: TruncatedFields) -> np.ndarray:
    """The ends of the lattice's edges that cross the surface, rims with their ends past the cut included,
    (N, N, N) bool."""
    n = fields.side
    sdf, msdf = fields.sdf.ravel(), fields.msdf.ravel()
    near = np.zeros(n**3, bool)
    for _, a, b in lattice_edges(n):
        crossing = ((sdf[a] < 0) != (sdf[b] < 0)) & ((msdf[a] > 0) | (msdf[b] > 0))
        near[a[crossing]] = near[b[crossing]] = True
    return near.reshape(n, n, n)


def _node(vertex: np.ndarray, n: int, offset: tuple[int, int, int]) -> tuple[np.ndarray, ...]:
    """Where on the doubled grid the middles of edges from these vertices are."""
    return tuple(2 * part + o for part, o in zip(np.unravel_index(vertex, (n, n, n)), offset, strict=True))


def _solved(row, a, b, weight_a, weight_b, right, importance, count: int) -> np.ndarray:
    """Least squares for values with ``weight_a x_a + weight_b x_b = right`` on every edge."""
    matrix = coo_array(
        (np.concatenate([weight_a, weight_b]), (np.concatenate([row, row]), np.concatenate([a, b]))),
        shape=(len(row), count),
    ).tocsr()
    normal = (matrix.T @ diags_array(importance) @ matrix + _DAMPING * diags_array(np.ones(count))).tocsr()
    jacobi = diags_array(1 / normal.diagonal())
    return cg(normal, matrix.T @ (importance * right), rtol=1e-6, maxiter=2000, M=jacobi)[0]
