"""The image itself, splatted in packets of channels.

On the CPU, additions of four or eight channels that lie side by side are one packet, several times as fast as
those of the five channels that colour, coverage and weight make; so a film's block gets channels of zeros.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from .supported_scenes import sensor_of

#: Sizes of packets.
_PACKETS = (1, 2, 4, 8)


def render(
    integrator: ADIntegrator, scene: mi.Scene, sensor: int | mi.Sensor, seed: int, spp: int
) -> mi.TensorXf:
    """The image that ``ADIntegrator.render`` gives."""
    sensor = sensor_of(scene, sensor)
    film, names = sensor.film(), integrator.aov_names()
    with dr.suspend_grad():
        sampler, spp = integrator.prepare(sensor, seed, spp, names)
        ray, weight, position = integrator.sample_rays(scene, sensor, sampler)
        value, valid, aovs, _ = integrator.sample(dr.ADMode.Primal, scene, sampler, ray)
        block = _PaddedBlock(film, spp)
        ADIntegrator._splat_to_block(
            block,
            film,
            position,
            value=value * weight,
            weight=1.0,
            alpha=dr.select(valid, mi.Float(1), mi.Float(0)),
            aovs=aovs,
            wavelengths=ray.wavelengths,
        )
        film.put_block(block.without_padding())
        return film.develop()


class _PaddedBlock:
    """An image block of a film, with channels up to the next size of packets."""

    def __init__(self, film: mi.Film, spp: int) -> None:
        own = film.create_block()
        self._count, self._border = own.channel_count(), film.sample_border()
        self._offset, self._filter = film.crop_offset(), film.rfilter()
        padded = next((size for size in _PACKETS if size >= self._count), self._count)
        # Merging the additions of a pixel's samples first only pays where they are many, and atomic.
        merge = own.coalesce() and spp >= 4 and dr.backend_v(mi.Float) == dr.JitBackend.CUDA
        self._block = mi.ImageBlock(
            film.crop_size(), self._offset, padded, self._filter, self._border, coalesce=merge
        )

    def channel_count(self) -> int:
        return self._count

    def put(self, position: mi.Point2f, values: list[mi.Float]) -> None:
        padding = self._block.channel_count() - len(values)
        self._block.put(position, [*values, *([mi.Float(0)] * padding)])

    def without_padding(self) -> mi.ImageBlock:
        channels = self._block.tensor()[..., : self._count]
        return mi.ImageBlock(channels, self._offset, self._filter, self._border)
