"""Differentiable splatting of samples to a film, unbiased at any number of samples.

``hdrfilm`` divides by the sum of the filter weights that happened to fall on a pixel. That is a good
image but, at few samples, a biased derivative once samples move. The derivative is therefore taken
of the image with expected weights,

    I_p = 1/E_p sum_i h(T(u_i) - p) L_i det_i,   E_p = spp * integral of h over the sampled domain,

whose noise is brought back down by a control variate: det(T) h(T(u) - p) integrates to a constant,
so a value that is independent of the samples can be subtracted from every L_i in the terms that
involve T. The samples of each pixel are split in halves, and the mean over one half is subtracted in
the other. (Leaving out sample i alone is biased: samples are stratified over pixels, so what is left
would depend on the pixel of i.)
"""

import drjit as dr
import mitsuba as mi


class FilmSplat:
    """The derivative of a film with respect to the values and positions of its samples.

    Parameters
    ----------
    film:
        The film; its filter, crop window and ``sample_border`` are honoured.
    spp:
        Samples per pixel.
    u:
        ``Point2f``: sample positions in pixels relative to the crop window.
    values:
        List of ``Float``: the channels of each sample, which ``adjoint`` and ``tangent`` need. They
        also take the samples to be in the order of their pixels.
    """

    def __init__(self, film, spp, u, values=()):
        self.spp, self.u, self.values = spp, dr.detach(u), [dr.detach(v) for v in values]
        self.width, self.height = film.crop_size()
        self.rfilter = film.rfilter()
        self.box = self.rfilter.is_box_filter()
        border = self.rfilter.border_size() if film.sample_border() else 0
        radius = self.rfilter.radius()
        self.taps = 1 if self.box else int(dr.ceil(2 * radius - 1e-3))
        # Lowest pixel whose centre is within the filter's reach
        self.base = (mi.Point2i(dr.floor(self.u)) if self.box else
                     mi.Point2i(dr.ceil(self.u - (radius + 0.5))))
        self.expected = [self._expected_weight(n, border) for n in (self.width, self.height)]
        self.expected[0] *= spp

    def _expected_weight(self, n, border):
        """Integral over the sampled interval of the filter at each of n pixels, one axis."""
        if self.box:
            return dr.ones(mi.Float, n)
        steps = 32
        reach = int(dr.ceil(self.rfilter.radius()))
        pixel = dr.arange(mi.Int32, n)
        total = dr.zeros(mi.Float, n)
        low, high = dr.opaque(mi.Float, -border), dr.opaque(mi.Float, n + border)
        for k in range(-reach * steps, reach * steps):
            x = (k + 0.5) / steps
            position = mi.Float(pixel) + 0.5 + x
            inside = (position > low) & (position < high)
            total += dr.select(inside, self.rfilter.eval(mi.Float(x)), 0)
        total /= steps
        dr.eval(total)
        return total

    def _filter(self, axis):
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

    def _taps(self):
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

    def _sums(self):
        """Per half of the samples and pixel: the sum of filter weights, and of weighted values."""
        n = self.width * self.height
        weight = dr.zeros(mi.Float, 2 * n)
        sums = [dr.zeros(mi.Float, 2 * n) for _ in self.values]
        first, _ = self._halves()
        for pixel, inside, h, _, _ in self._taps():
            dr.scatter_add(weight, h, first + pixel, inside)
            for s, v in zip(sums, self.values, strict=True):
                dr.scatter_add(s, h * v, first + pixel, inside)
        dr.eval(weight, sums)
        return weight, sums

    def _halves(self):
        """Where the sums of a sample's own half and of the other one begin."""
        n = dr.opaque(mi.UInt32, self.width * self.height)
        index = dr.arange(mi.UInt32, dr.width(self.u))
        half = (index - index // dr.opaque(mi.UInt32, self.spp) * dr.opaque(mi.UInt32, self.spp)) & 1
        return half * n, (1 - half) * n

    def gather(self, image):
        """Per sample and channel the filtered image value: the adjoint of splatting values."""
        result = [mi.Float(0) for _ in image]
        for pixel, inside, h, _, scale in self._taps():
            for c, channel in enumerate(image):
                result[c] += h * scale * dr.gather(mi.Float, channel, pixel, inside)
        return result

    def scatter(self, values):
        """The image of samples with the given channels."""
        result = [dr.zeros(mi.Float, self.width * self.height) for _ in values]
        for pixel, inside, h, _, scale in self._taps():
            for image, value in zip(result, values, strict=True):
                dr.scatter_add(image, h * scale * value, pixel, inside)
        dr.eval(result)
        return result

    def adjoint(self, image_adjoint):
        """Adjoints of the values, of the displacement T(u) - u and of det, for an image adjoint.

        ``image_adjoint``: list of ``Float``, one per channel, width pixels.
        """
        weight, sums = self._sums()
        product = dr.zeros(mi.Float, dr.width(weight))
        pixel = dr.arange(mi.UInt32, dr.width(weight)) % dr.opaque(mi.UInt32, self.width * self.height)
        for g, s in zip(image_adjoint, sums, strict=True):
            product += dr.gather(mi.Float, g, pixel) * s
        dr.eval(product)
        _, other = self._halves()
        on_values = [mi.Float(0) for _ in self.values]
        on_shift, on_det = mi.Vector2f(0), mi.Float(0)
        for pixel, inside, h, slope, scale in self._taps():
            own = mi.Float(0)
            for c, (g, v) in enumerate(zip(image_adjoint, self.values, strict=True)):
                gc = dr.gather(mi.Float, g, pixel, inside)
                on_values[c] += h * scale * gc
                own += gc * v
            rest = dr.gather(mi.Float, weight, other + pixel, inside)
            others = dr.gather(mi.Float, product, other + pixel, inside) / rest
            contrast = (own - dr.select(dr.abs(rest) > 1e-2, others, 0)) * scale
            on_shift += slope * contrast
            on_det += h * contrast
        return on_values, on_shift, on_det

    def tangent(self, value_tangents, shift, divergence):
        """The image tangent for tangents of the values, of T(u) - u and of det."""
        weight, sums = self._sums()
        _, other = self._halves()
        result = [dr.zeros(mi.Float, self.width * self.height) for _ in self.values]
        for pixel, inside, h, slope, scale in self._taps():
            moved = dr.dot(slope, shift) + h * divergence
            rest = dr.gather(mi.Float, weight, other + pixel, inside)
            for r, s, v, dv in zip(result, sums, self.values, value_tangents, strict=True):
                others = dr.gather(mi.Float, s, other + pixel, inside) / rest
                others = dr.select(dr.abs(rest) > 1e-2, others, 0)
                dr.scatter_add(r, scale * (h * dv + moved * (v - others)), pixel, inside)
        dr.eval(result)
        return result
