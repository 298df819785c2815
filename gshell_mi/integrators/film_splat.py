"""Differentiable splatting of samples to a film, unbiased at any number of samples.

``hdrfilm`` divides by the sum of the filter weights that happened to fall on a pixel. That is a good
image but, at few samples, a biased derivative once samples move. The derivative is therefore taken
of the image with expected weights,

    I_p = 1/E_p sum_i h(T(u_i) - p) L_i det_i,   E_p = spp * integral of h over the sampled domain,

whose noise is brought back down by a control variate: det(T) h(T(u) - p) integrates to a constant,
so a value that is independent of the samples can be subtracted from every L_i in the terms that
involve T. The samples of each pixel are split in halves, and an image made of one half is subtracted
in the other. (Leaving out sample i alone is biased: samples are stratified over pixels, so what is
left would depend on the pixel of i.) That image is a filtered one of the pixels' means: any image
will do, and this one needs no atomic additions per sample.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy

import drjit as dr
import mitsuba as mi


class FilmSplat:
    """The derivative of a film with respect to the values and positions of its samples.

    Args:
        film: the film; its filter, crop window and ``sample_border`` are honoured.
        spp: samples per pixel.
        u: ``Point2f``: sample positions in pixels relative to the crop window.
        values: list of ``Float``: the channels of each sample, which ``adjoint`` and ``tangent`` need. They
            also take the samples to be in the order of their pixels.
    """

    def __init__(self, film: mi.Film, spp: int, u: mi.Point2f, values: Sequence[mi.Float] = ()) -> None:
        self.spp, self.u, self.values = spp, dr.detach(u), [dr.detach(v) for v in values]
        self.width, self.height = film.crop_size()
        self.rfilter = film.rfilter()
        self.box = self.rfilter.is_box_filter()
        self.border = self.rfilter.border_size() if film.sample_border() else 0
        radius = self.rfilter.radius()
        self.taps = 1 if self.box else int(dr.ceil(2 * radius - 1e-3))
        # Lowest pixel whose centre is within the filter's reach
        self.base = mi.Point2i(dr.floor(self.u)) if self.box else mi.Point2i(dr.ceil(self.u - (radius + 0.5)))
        self.expected = [self._expected_weight(n) for n in (self.width, self.height)]
        self.expected[0] *= spp

    def _expected_weight(self, n: int) -> mi.Float:
        """Integral over the sampled interval of the filter at each of n pixels, one axis."""
        if self.box:
            return dr.ones(mi.Float, n)
        steps = 32
        reach = int(dr.ceil(self.rfilter.radius()))
        pixel = dr.arange(mi.Int32, n)
        total = dr.zeros(mi.Float, n)
        low, high = dr.opaque(mi.Float, -self.border), dr.opaque(mi.Float, n + self.border)
        for k in range(-reach * steps, reach * steps):
            x = (k + 0.5) / steps
            position = mi.Float(pixel) + 0.5 + x
            inside = (position > low) & (position < high)
            total += dr.select(inside, self.rfilter.eval(mi.Float(x)), 0)
        total /= steps
        dr.eval(total)
        return total

    def _filter(self, axis: int) -> list[tuple[mi.Float, mi.Float]]:
        """Filter value and slope at each tap along one axis."""
        result = []
        for k in range(self.taps):
            if self.box:
                result.append((mi.Float(1), mi.Float(0)))
                continue
            x = self.u[axis] - (mi.Float(self.base[axis] + k) + 0.5)
            with dr.resume_grad():
                dr.enable_grad(x)
                h = self.rfilter.eval(x)
                dr.set_grad(x, 1.0)
                dr.forward_to(h)
                slope = dr.grad(h)
            result.append((dr.detach(h), slope))
        return result

    def _taps(self) -> Iterator[tuple[mi.UInt32, mi.Bool, mi.Float, mi.Vector2f, mi.Float]]:
        """Yields pixel index, whether it lies in the film, weight and its gradient for each tap."""
        along_x, along_y = self._filter(0), self._filter(1)
        for j, (hy, sy) in enumerate(along_y):
            y = self.base.y + j
            ey = dr.gather(mi.Float, self.expected[1], mi.UInt32(y), (y >= 0) & (y < self.height))
            for i, (hx, sx) in enumerate(along_x):
                x = self.base.x + i
                inside = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
                ex = dr.gather(mi.Float, self.expected[0], mi.UInt32(x), inside)
                scale = dr.select(inside, dr.rcp(ex * ey), 0)
                yield mi.UInt32(y * self.width + x), inside, hx * hy, mi.Vector2f(sx * hy, hx * sy), scale

    def _control(self) -> list[mi.Float]:
        """Per half of the samples and pixel a rough image of the values, made of the other half.

        Its pixels are those of the film without border; the second half follows the first.
        """
        spp = self.spp
        columns, rows = self.width + 2 * self.border, self.height + 2 * self.border
        n = dr.opaque(mi.UInt32, self.width * self.height)
        pixel = dr.arange(mi.UInt32, self.width * self.height)
        y = pixel // dr.opaque(mi.UInt32, self.width)
        x = pixel - y * dr.opaque(mi.UInt32, self.width)
        half_of = self._half(dr.arange(mi.UInt32, dr.width(self.u)))
        result = [dr.zeros(mi.Float, 2 * self.width * self.height) for _ in self.values]
        if spp < 2:
            return result
        reach = 0 if self.box else max(int(dr.ceil(self.rfilter.radius() - 0.5)), 0)
        taps = range(-reach, reach + 1)
        kernel = [self.rfilter.eval(mi.Float(abs(k))) for k in taps]
        for k, v in enumerate(self.values):
            sums = dr.block_sum(v, spp)
            in_first = dr.block_sum(dr.select(half_of == 0, v, 0), spp)
            dr.eval(sums, in_first)
            for half, total, count in ((0, sums - in_first, spp // 2), (1, in_first, spp - spp // 2)):
                dr.eval(total)
                value, weight = mi.Float(0), mi.Float(0)
                for j, hy in zip(taps, kernel, strict=True):
                    for i, hx in zip(taps, kernel, strict=True):
                        cx, cy = mi.Int32(x) + (i + self.border), mi.Int32(y) + (j + self.border)
                        inside = (cx >= 0) & (cx < columns) & (cy >= 0) & (cy < rows)
                        h = dr.select(inside, hx * hy, 0)
                        value += h * dr.gather(mi.Float, total, mi.UInt32(cy * columns + cx), inside)
                        weight += h
                dr.scatter(result[k], value / (weight * count), pixel + half * n, mode=dr.ReduceMode.Permute)
        dr.eval(result)
        return result

    def mean_control(self) -> list[mi.Float]:
        """Per pixel and channel what is subtracted from the samples on average."""
        n = self.width * self.height
        pixel = dr.arange(mi.UInt32, n)
        share = (self.spp - self.spp // 2) / self.spp
        second = pixel + dr.opaque(mi.UInt32, n)
        return [
            share * dr.gather(mi.Float, c, pixel) + (1 - share) * dr.gather(mi.Float, c, second)
            for c in self._control()
        ]

    def _half(self, index: mi.UInt32) -> mi.UInt32:
        """Which half the samples with these numbers belong to."""
        spp = dr.opaque(mi.UInt32, self.spp)
        return (index - index // spp * spp) & 1

    def gather(self, image: list[mi.Float]) -> list[mi.Float]:
        """Per sample and channel the filtered image value: the adjoint of splatting values."""
        result = [mi.Float(0) for _ in image]
        for pixel, inside, h, _, scale in self._taps():
            for c, channel in enumerate(image):
                result[c] += h * scale * dr.gather(mi.Float, channel, pixel, inside)
        return result

    def scatter(self, values: list[mi.Float]) -> list[mi.Float]:
        """The image of samples with the given channels."""
        result = [dr.zeros(mi.Float, self.width * self.height) for _ in values]
        for pixel, inside, h, _, scale in self._taps():
            for image, value in zip(result, values, strict=True):
                dr.scatter_add(image, h * scale * value, pixel, inside)
        dr.eval(result)
        return result

    def take(self, index: mi.UInt32) -> FilmSplat:
        """The splat of the samples with these numbers, as far as taps are concerned."""
        result = copy(self)
        result.u = dr.gather(mi.Point2f, self.u, index)
        result.base = dr.gather(mi.Point2i, self.base, index)
        result.values = [dr.gather(mi.Float, v, index) for v in self.values]
        return result

    def adjoint(self, image_adjoint: list[mi.Float], index: mi.UInt32) -> tuple[mi.Vector2f, mi.Float]:
        """Adjoints of the displacement T(u) - u and of det of some samples, for an image adjoint.

        ``image_adjoint``: list of ``Float``, one per channel, width pixels; ``index``: ``UInt32``, which
        samples.
        """
        control = self._control()
        product = mi.Float(0)
        pixel = dr.arange(mi.UInt32, 2 * self.width * self.height)
        pixel %= dr.opaque(mi.UInt32, self.width * self.height)
        for g, c in zip(image_adjoint, control, strict=True):
            product += dr.gather(mi.Float, g, pixel) * c
        dr.eval(product)
        own_control = self._half(index) * dr.opaque(mi.UInt32, self.width * self.height)
        on_shift, on_det = mi.Vector2f(0), mi.Float(0)
        some = self.take(index)
        for pixel, inside, h, slope, scale in some._taps():
            own = mi.Float(0)
            for g, v in zip(image_adjoint, some.values, strict=True):
                own += dr.gather(mi.Float, g, pixel, inside) * v
            contrast = (own - dr.gather(mi.Float, product, own_control + pixel, inside)) * scale
            on_shift += slope * contrast
            on_det += h * contrast
        return on_shift, on_det

    def tangent(
        self, value_tangents: list[mi.Float], shift: mi.Vector2f, divergence: mi.Float
    ) -> list[mi.Float]:
        """The image tangent for tangents of the values, of T(u) - u and of det."""
        control = self._control()
        half = self._half(dr.arange(mi.UInt32, dr.width(self.u)))
        own_control = half * dr.opaque(mi.UInt32, self.width * self.height)
        result = [dr.zeros(mi.Float, self.width * self.height) for _ in self.values]
        for pixel, inside, h, slope, scale in self._taps():
            moved = dr.dot(slope, shift) + h * divergence
            for r, c, v, dv in zip(result, control, self.values, value_tangents, strict=True):
                others = dr.gather(mi.Float, c, own_control + pixel, inside)
                dr.scatter_add(r, scale * (h * dv + moved * (v - others)), pixel, inside)
        dr.eval(result)
        return result
