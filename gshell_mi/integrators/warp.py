"""A warp of the film that moves with the silhouettes: velocity and divergence at sample positions.

With ``u`` a sample position and an edge from ``a`` to ``b`` whose end points move at ``a'``, ``b'``,
let ``t`` be the parameter of the point nearest to ``u``, ``d`` its distance, and

    w = max(0, 1/d - 1/r),   W = 1/r + sum w,   V = sum w/W ((1-t) a' + t b').

``V`` is continuous, equals the motion of the edge on the edge, and vanishes ``r`` pixels away; this
makes ``u -> u + V`` a valid reparameterisation of the film (Loubet et al. 2019; Bangaru et al. 2020,
here with a deterministic weight over an explicit list of edges). Its divergence is known in closed
form, so no auxiliary rays are needed.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .edge_table import SIZE_INDEPENDENT


class EdgeGrid:
    """For each pixel of a rectangle the edge pieces within ``radius`` of it.

    Args:
        a, b: ``Point2f``: end points in pixels.
        radius: reach of the warp in pixels.
        origin, size: integer corner and extent of the rectangle in pixels.
    """

    def __init__(
        self, a: mi.Point2f, b: mi.Point2f, radius: float, origin: tuple[int, int], size: tuple[int, int]
    ) -> None:
        self.radius = dr.opaque(mi.Float, radius)
        self.origin = mi.Point2i(dr.opaque(mi.Int32, origin[0]), dr.opaque(mi.Int32, origin[1]))
        self.size = mi.Point2i(dr.opaque(mi.Int32, size[0]), dr.opaque(mi.Int32, size[1]))
        a, b = dr.detach(a), dr.detach(b)
        n = dr.width(a)
        self.ends = dr.zeros(mi.Float, 4 * n)
        index = 4 * dr.arange(mi.UInt32, n)
        for k, x in enumerate((a.x, a.y, b.x, b.y)):
            dr.scatter(self.ends, x, index + k, mode=dr.ReduceMode.Permute)

        cells = size[0] * size[1]
        counter = dr.zeros(mi.UInt32, cells)
        dr.eval(counter, self.ends)
        self._visit_cells(a, b, counter, None, None)
        self.first = dr.prefix_sum(counter)
        self.last = self.first + counter
        total = dr.sum(counter)
        dr.eval(self.first, self.last, total)
        self.pieces = dr.zeros(mi.UInt32, max(total[0], 1))
        cursor = self.first + dr.opaque(mi.UInt32, 0)  # a copy: the loop increments it in place
        dr.eval(cursor, self.pieces)
        self._visit_cells(a, b, cursor, self.pieces, dr.arange(mi.UInt32, n))
        dr.eval(self.pieces)

    @dr.syntax
    def _visit_cells(
        self,
        a: mi.Point2f,
        b: mi.Point2f,
        counter: mi.UInt32,
        pieces: mi.UInt32 | None,
        index: mi.UInt32 | None,
    ) -> None:
        reach = self.radius + 0.7072  # half the diagonal of a pixel
        low = mi.Point2i(dr.floor(dr.minimum(a, b) - self.radius)) - self.origin
        high = mi.Point2i(dr.floor(dr.maximum(a, b) + self.radius)) - self.origin
        low, high = dr.maximum(low, 0), dr.minimum(high, self.size - 1)
        active = dr.all(low <= high)
        x, y = mi.Int32(low.x), mi.Int32(low.y)
        while active:
            centre = mi.Point2f(mi.Point2i(x, y) + self.origin) + 0.5
            _, d, _ = nearest_on_segment(centre, a, b)
            near = active & (d <= reach)
            cell = mi.UInt32(y * self.size.x + x)
            slot = dr.scatter_inc(counter, cell, near)
            if dr.hint(pieces is not None, mode="scalar"):
                dr.scatter(pieces, index, slot, near, mode=dr.ReduceMode.Permute)
            x += 1
            y = dr.select(x > high.x, y + 1, y)
            x = dr.select(x > high.x, low.x, x)
            active &= y <= high.y

    def list_at(self, u: mi.Point2f) -> tuple[mi.UInt32, mi.UInt32]:
        """First and one-past-last position in ``pieces`` for the pixel that holds ``u``."""
        cell = mi.Point2i(dr.floor(u)) - self.origin
        inside = dr.all((cell >= 0) & (cell < self.size))
        index = mi.UInt32(cell.y * self.size.x + cell.x)
        return dr.gather(mi.UInt32, self.first, index, inside), dr.gather(mi.UInt32, self.last, index, inside)


def nearest_on_segment(u: mi.Point2f, a: mi.Point2f, b: mi.Point2f) -> tuple[mi.Float, mi.Float, mi.Vector2f]:
    """Parameter, distance and (unnormalised) offset of the point of the segment nearest to ``u``."""
    e = b - a
    t = dr.clip(dr.dot(u - a, e) / dr.maximum(dr.squared_norm(e), 1e-20), 0, 1)
    offset = u - dr.fma(t, e, a)
    return t, dr.norm(offset), offset


def _weight(
    grid: EdgeGrid, u: mi.Point2f, piece: mi.UInt32, active: mi.Bool
) -> tuple[mi.Float, mi.Vector2f, mi.Float, mi.Vector2f]:
    """Weight, its gradient, segment parameter and its gradient for one piece."""
    ends = dr.gather(mi.Vector4f, grid.ends, piece, active)
    a, b = mi.Point2f(ends.x, ends.y), mi.Point2f(ends.z, ends.w)
    t, d, offset = nearest_on_segment(u, a, b)
    inv_d = dr.rcp(dr.maximum(d, 1e-4))
    near = active & (d < grid.radius)
    w = dr.select(near, inv_d - dr.rcp(grid.radius), 0)
    grad_w = dr.select(near, -mi.Vector2f(offset) * inv_d * inv_d * inv_d, 0)
    e = mi.Vector2f(b - a)
    grad_t = dr.select((t > 0) & (t < 1), e / dr.maximum(dr.squared_norm(e), 1e-20), 0)
    return w, grad_w, t, grad_t


class FilmWarp(dr.CustomOp):
    """Value zero; derivative: velocity ``V`` (``Vector2f``) and divergence (``Float``) of the warp.

    Inputs: end points ``a``, ``b`` (attached), the ``EdgeGrid``, sample positions ``u``, and the
    weight of immovable lines (``Float``) and its gradient (``Vector2f``) at each sample, or zeros.
    """

    def eval(
        self,
        a: mi.Point2f,
        b: mi.Point2f,
        grid: EdgeGrid,
        u: mi.Point2f,
        fixed: mi.Float,
        grad_fixed: mi.Vector2f,
    ) -> tuple[mi.Vector2f, mi.Float]:
        self.grid, self.u, self.count = grid, u, dr.width(a)
        self.fixed, self.grad_fixed = fixed, grad_fixed
        n = dr.width(u)
        return dr.zeros(mi.Vector2f, n), dr.zeros(mi.Float, n)

    @dr.syntax
    def _normaliser(self, tangents: mi.Float | None) -> tuple[mi.Float, mi.Vector2f, mi.Vector2f, mi.Float]:
        """Sums over the pieces near each sample; the last two only if tangents are given."""
        grid, u = self.grid, self.u
        k, last = grid.list_at(u)
        total, grad_total = dr.rcp(grid.radius) + self.fixed, mi.Vector2f(self.grad_fixed)
        moved, spread = mi.Vector2f(0), mi.Float(0)
        while k < last:
            piece = dr.gather(mi.UInt32, grid.pieces, k)
            w, grad_w, t, grad_t = _weight(grid, u, piece, mi.Bool(True))
            total += w
            grad_total += grad_w
            if dr.hint(tangents is not None, mode="scalar"):
                v = dr.gather(mi.Vector4f, tangents, piece)
                va, vb = mi.Vector2f(v.x, v.y), mi.Vector2f(v.z, v.w)
                ve = dr.lerp(va, vb, t)
                moved += w * ve
                spread += dr.dot(grad_w, ve) + w * dr.dot(grad_t, vb - va)
            k += 1
        return total, grad_total, moved, spread

    def forward(self) -> None:
        va, vb = self.grad_in("a"), self.grad_in("b")
        tangents = dr.zeros(mi.Float, 4 * self.count)
        index = 4 * dr.arange(mi.UInt32, self.count)
        for k, x in enumerate((va.x, va.y, vb.x, vb.y)):
            dr.scatter(tangents, x, index + k, mode=dr.ReduceMode.Permute)
        dr.eval(tangents)
        total, grad_total, moved, spread = self._normaliser(tangents)
        self.set_grad_out((moved / total, spread / total - dr.dot(moved, grad_total) / dr.square(total)))

    @dr.syntax
    def backward(self) -> None:
        velocity, divergence = self.grad_out()
        grid, u = self.grid, self.u
        total, grad_total, _, _ = self._normaliser(None)
        inv = dr.rcp(total)
        adjoint = dr.zeros(mi.Float, 4 * self.count)
        dr.eval(total, grad_total, velocity, divergence, adjoint)
        k, last = grid.list_at(u)
        while k < last:
            piece = dr.gather(mi.UInt32, grid.pieces, k)
            w, grad_w, t, grad_t = _weight(grid, u, piece, mi.Bool(True))
            on_point = w * inv * velocity + divergence * inv * (grad_w - w * inv * grad_total)
            stretch = divergence * w * inv * grad_t
            on_a, on_b = (1 - t) * on_point - stretch, t * on_point + stretch
            near = w > 0
            for j, x in enumerate((on_a.x, on_a.y, on_b.x, on_b.y)):
                dr.scatter_add(adjoint, x, 4 * piece + j, near, mode=SIZE_INDEPENDENT)
            k += 1
        index = 4 * dr.arange(mi.UInt32, self.count)
        ax, ay, bx, by = (dr.gather(mi.Float, adjoint, index + j) for j in range(4))
        self.set_grad_in("a", mi.Point2f(ax, ay))
        self.set_grad_in("b", mi.Point2f(bx, by))

    def name(self) -> str:
        return "film warp"


def fixed_line_weight(
    u: mi.Point2f, lines: list[tuple[int, mi.Float]], radius: float
) -> tuple[mi.Float, mi.Vector2f]:
    """Weight and gradient for axis-aligned lines that must not move (frame, pixel borders).

    ``lines``: list of ``(axis, coordinate)``, the coordinate a ``Float``.
    """
    total, grad = mi.Float(0), mi.Vector2f(0)
    for axis, coordinate in lines:
        offset = u[axis] - coordinate
        d = dr.maximum(dr.abs(offset), 1e-4)
        near = d < radius
        total += dr.select(near, dr.rcp(d) - 1 / radius, 0)
        grad[axis] += dr.select(near, -dr.sign(offset) / dr.square(d), 0)
    return total, grad
