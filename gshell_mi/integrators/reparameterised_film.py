"""Forward and reverse derivatives of a film whose samples move with the silhouettes.

The image is I_p = integral of h(T(u) - p) L(T(u)) det T(u) du, with T the warp of
:mod:`~gshell_mi.integrators.warp`: the identity at the current parameters, with a derivative that
follows the silhouettes. Inside the integral everything is then continuous and ordinary automatic
differentiation is right.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..errors import UserError
from .film_splat import FilmSplat
from .silhouette_edges import screen_edges
from .warp import EdgeGrid, FilmWarp, fixed_line_weight


@dataclass
class CameraSamples:
    """Positions on the film and the other random numbers that a sensor needs."""

    u: object           #: ``Point2f``: pixels relative to the crop window
    time: object        #: ``Float``
    wavelength: object  #: ``Float``
    origin: tuple       #: lowest pixel sampled, relative to the crop window
    size: tuple         #: extent in pixels of what is sampled

    @staticmethod
    def draw(sensor, sampler):
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

    def rays(self, sensor, u):
        """Camera rays through film positions, attached to them and to the sensor."""
        film = sensor.film()
        return sensor.sample_ray(self.time, self.wavelength, u / mi.Vector2f(film.crop_size()),
                                 mi.Point2f(0.5))


def check_sensor(sensor):
    """Raises for sensors whose silhouettes are not those of one viewpoint."""
    if sensor.class_name() != "PerspectiveCamera":
        raise UserError(f"Sensor '{sensor.id()}' is a {sensor.class_name()}: gshell_path and gshell_mask "
                        "differentiate 'perspective' sensors only; use one of these, or mi.render() "
                        "without derivatives.")
    if mi.has_flag(sensor.film().flags(), mi.FilmFlags.Special):
        raise UserError(f"The film of sensor '{sensor.id()}' has its own sample format, which gshell_path "
                        "and gshell_mask cannot differentiate; use 'hdrfilm'.")


def film_channels(film, value, alpha, aovs, wavelengths):
    """The channels that a sample splats, without the weight: colour, alpha if kept, AOVs."""
    value = mi.unpolarized_spectrum(value)
    if mi.is_spectral:
        value = mi.spectrum_to_srgb(value, wavelengths)
    elif mi.is_monochromatic:
        value = mi.Color3f(value.x)
    channels = [value.x, value.y, value.z]
    if mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
        channels.append(alpha)
    return channels + list(aovs)


def _develop(film, channels, aov_names):
    """The film's image of given pixel values; linear, so it maps tangents as well as values."""
    film.prepare(aov_names)
    width, height = film.crop_size()
    n = width * height
    split = len(channels) - len(aov_names)
    layers = [*channels[:split], dr.ones(mi.Float, n), *channels[split:]]
    data = dr.zeros(mi.Float, n * len(layers))
    pixel = dr.arange(mi.UInt32, n) * len(layers)
    for k, layer in enumerate(layers):
        dr.scatter(data, layer, pixel + k, mode=dr.ReduceMode.Permute)
    block = mi.ImageBlock(mi.TensorXf(data, (height, width, len(layers))), film.crop_offset())
    film.put_block(block)
    return film.develop()


def _develop_adjoint(film, image_adjoint, count, aov_names):
    """Adjoint of :func:`_develop`: per channel the adjoint of each pixel."""
    width, height = film.crop_size()
    with dr.resume_grad():
        channels = [dr.zeros(mi.Float, width * height) for _ in range(count)]
        dr.enable_grad(channels)
        image = _develop(film, channels, aov_names)
        dr.set_grad(image, image_adjoint)
        dr.enqueue(dr.ADMode.Backward, image)
        dr.traverse(dr.ADMode.Backward)
        result = [dr.grad(c) for c in channels]
    film.clear()
    dr.eval(result)
    return result


def _warped(scene, sensor, samples, integrator):
    """T(u) and det T(u), attached."""
    film = sensor.film()
    u = samples.u
    edges = screen_edges(scene, sensor, integrator.warp_radius + 2 + max(-samples.origin[0], 0),
                         cull=integrator.cull_hidden)
    if edges is None or not (dr.grad_enabled(edges.a) or dr.grad_enabled(edges.b)):
        return mi.Point2f(u), mi.Float(1)
    fixed, grad_fixed = mi.Float(0), mi.Vector2f(0)
    if film.rfilter().is_box_filter():
        cell = dr.floor(u)
        fixed, grad_fixed = fixed_line_weight(u, [(k, cell[k] + s) for k in (0, 1) for s in (0, 1)], 0.5)
    elif not film.sample_border():
        size = mi.Point2f(film.crop_size())
        lines = [(k, edge) for k in (0, 1) for edge in (mi.Float(0), size[k])]
        fixed, grad_fixed = fixed_line_weight(u, lines, integrator.warp_radius)
    grid = EdgeGrid(edges.a, edges.b, integrator.warp_radius, samples.origin, samples.size)
    dr.eval(fixed, grad_fixed)
    with dr.resume_grad():
        velocity, divergence = dr.custom(FilmWarp, edges.a, edges.b, grid, u, fixed, grad_fixed)
        return u + velocity, 1 + divergence


def _prepare(integrator, scene, sensor, seed, spp):
    if isinstance(sensor, int):
        sensor = scene.sensors()[sensor]
    check_sensor(sensor)
    sampler, spp = integrator.prepare(sensor, seed, spp, integrator.aov_names())
    samples = CameraSamples.draw(sensor, sampler)
    dr.eval(samples.u, samples.time, samples.wavelength)
    return sensor, sampler, spp, samples


def _primal(integrator, scene, sensor, sampler, samples):
    ray, weight = samples.rays(sensor, samples.u)
    state = integrator.primal(scene, sampler.clone(), ray)
    dr.eval(state)
    channels = film_channels(sensor.film(), state.value * weight, state.alpha, state.aovs, ray.wavelengths)
    return state, channels


def render_backward(integrator, scene, grad_in, sensor, seed, spp):
    """Adds the derivative of ``<grad_in, image>`` to the gradients of the scene's parameters."""
    with dr.suspend_grad():
        sensor, sampler, spp, samples = _prepare(integrator, scene, sensor, seed, spp)
        film = sensor.film()
        state, values = _primal(integrator, scene, sensor, sampler, samples)
        image_adjoint = _develop_adjoint(film, grad_in, len(values), integrator.aov_names())
        on_values, on_shift, on_det = FilmSplat(film, spp, samples.u, values).adjoint(image_adjoint)
        dr.eval(on_values, on_shift, on_det)
        with dr.resume_grad():
            shifted, det = _warped(scene, sensor, samples, integrator)
            ray, weight = samples.rays(sensor, shifted)

            def on_sample(value, alpha, aovs):
                channels = film_channels(film, value * weight, alpha, aovs, ray.wavelengths)
                return sum(x * d for x, d in zip(channels, on_values, strict=True))

            total = integrator.attached(dr.ADMode.Backward, scene, sampler, ray, state, on_sample)
            total += dr.dot(shifted, on_shift) + det * on_det
            dr.backward_from(total)
        dr.eval()


def render_forward(integrator, scene, sensor, seed, spp):
    """The derivative of the image along the tangents set on the scene's parameters."""
    with dr.suspend_grad():
        sensor, sampler, spp, samples = _prepare(integrator, scene, sensor, seed, spp)
        film = sensor.film()
        state, values = _primal(integrator, scene, sensor, sampler, samples)
        with dr.resume_grad():
            shifted, det = _warped(scene, sensor, samples, integrator)
            ray, weight = samples.rays(sensor, shifted)

            def on_sample(value, alpha, aovs):
                return film_channels(film, value * weight, alpha, aovs, ray.wavelengths)

            tangents, (shift, divergence) = integrator.attached(
                dr.ADMode.Forward, scene, sampler, ray, state, on_sample, (shifted, det))
        dr.eval(tangents, shift, divergence)
        image = FilmSplat(film, spp, samples.u, values).tangent(tangents, shift, divergence)
        return _develop(film, image, integrator.aov_names())
