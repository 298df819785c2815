"""The samples of a film: where they are, and which of them a derivative depends on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

if TYPE_CHECKING:
    from .film_integrator import FilmIntegrator
    from .reparameterised_film import Warp


@dataclass
class CameraSamples:
    """Positions on the film and the other random numbers that a sensor needs."""

    u: mi.Point2f  #: pixels relative to the crop window
    time: mi.Float
    wavelength: mi.Float
    origin: tuple[int, int]  #: lowest pixel sampled, relative to the crop window
    size: tuple[int, int]  #: extent in pixels of what is sampled

    @staticmethod
    def draw(sensor: mi.Sensor, sampler: mi.Sampler) -> CameraSamples:
        film = sensor.film()
        border = film.rfilter().border_size() if film.sample_border() else 0
        width, height = (int(n) + 2 * border for n in film.crop_size())
        spp = sampler.sample_count()
        index = dr.arange(mi.UInt32, width * height * spp) // dr.opaque(mi.UInt32, spp)
        row = index // dr.opaque(mi.UInt32, width)
        column = index - row * dr.opaque(mi.UInt32, width)
        u = mi.Point2f(mi.Float(column), mi.Float(row)) - border + sampler.next_2d()
        time = mi.Float(sensor.shutter_open())
        if sensor.shutter_open_time() > 0:
            time += sampler.next_1d() * sensor.shutter_open_time()
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        return CameraSamples(u, time, wavelength, (-border, -border), (width, height))

    def take(self, index: mi.UInt32) -> CameraSamples:
        """The samples with these numbers."""
        time, wavelength = (
            x if dr.width(x) == 1 else dr.gather(mi.Float, x, index) for x in (self.time, self.wavelength)
        )
        return CameraSamples(dr.gather(mi.Point2f, self.u, index), time, wavelength, self.origin, self.size)

    def rays(self, sensor: mi.Sensor, u: mi.Point2f) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Camera rays through film positions, attached to them and to the sensor."""
        film = sensor.film()
        return sensor.sample_ray(
            self.time, self.wavelength, u / mi.Vector2f(film.crop_size()), mi.Point2f(0.5)
        )


def numbers_of(selected: mi.Bool) -> mi.UInt32:
    """The numbers of the selected samples, and the first two: kernels for none or one would be others."""
    return dr.compress(selected | (dr.arange(mi.UInt32, dr.width(selected)) < 2))


def not_lost(
    integrator: FilmIntegrator,
    scene: mi.Scene,
    sensor: mi.Sensor,
    samples: CameraSamples,
    sampler: mi.Sampler,
    warp: Warp,
    seed: int,
) -> tuple[mi.UInt32 | None, CameraSamples, mi.Sampler]:
    """The samples that see something or are close to a silhouette.

    The others are black whatever changes, so nothing need be traced for them: on a photograph of one object
    most of the film. Samplers whose numbers depend on the sample's own keep all of them.

    Returns their numbers, or ``None`` for all, the samples, and a sampler for them.
    """
    black = integrator.hide_emitters or scene.environment() is None
    if not black or sensor.sampler().class_name() != "IndependentSampler":
        return None, samples, sampler
    ray, _ = samples.rays(sensor, samples.u)
    index = numbers_of(scene.ray_test(ray) | warp.is_near(samples.u))
    if dr.width(index) == dr.width(samples.u):
        return None, samples, sampler
    taken = samples.take(index)
    own = sampler.clone()
    own.seed(mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(2))[0], dr.width(index))
    dr.eval(taken.u, taken.time, taken.wavelength)
    return index, taken, own
