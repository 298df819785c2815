"""Forward and reverse derivatives of a film whose samples move with the silhouettes.

The image is I_p = integral of h(T(u) - p) L(T(u)) det T(u) du, with T the warp of
``warp``: the identity at the current parameters, with a derivative that
follows the silhouettes. Inside the integral everything is then continuous and ordinary automatic
differentiation is right.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .camera_samples import CameraSamples, not_lost, numbers_of
from .edge_table import EdgeTable, scene_edge_tables
from .film_integrator import FilmIntegrator
from .film_splat import FilmSplat
from .path_sample import PathSample
from .pixel_borders import PixelBorders
from .silhouette_edges import screen_edges
from .supported_scenes import check_meshes, check_sensor, sensor_of, warn_once
from .warp import EdgeGrid, FilmWarp, fixed_line_weight


def film_channels(
    film: mi.Film, value: mi.Spectrum, alpha: mi.Float, aovs: list[mi.Float], wavelengths: mi.Color0f
) -> list[mi.Float]:
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


def _develop(film: mi.Film, channels: list[mi.Float], aov_names: list[str]) -> mi.TensorXf:
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


def _develop_adjoint(
    film: mi.Film, image_adjoint: mi.TensorXf, count: int, aov_names: list[str]
) -> list[mi.Float]:
    """Adjoint of ``_develop``: per channel the adjoint of each pixel."""
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


class Warp:
    """The warp T of the film that follows the silhouettes of a scene's meshes."""

    def __init__(
        self,
        scene: mi.Scene,
        tables: list[tuple[mi.Mesh, EdgeTable]],
        sensor: mi.Sensor,
        samples: CameraSamples,
        integrator: FilmIntegrator,
    ) -> None:
        self.film, self.radius = sensor.film(), integrator.warp_radius
        margin = self.radius + 2 - samples.origin[0]
        self.edges = screen_edges(
            scene, tables, sensor, margin, cull=integrator.cull_hidden, crease_angle=integrator.crease_angle
        )
        self.grid: EdgeGrid | None = None
        if self.edges is None:
            return
        with dr.resume_grad():
            moving = dr.grad_enabled((self.edges.a, self.edges.b))
        if moving:
            self.grid = EdgeGrid(self.edges.a, self.edges.b, self.radius, samples.origin, samples.size)

    def __call__(self, u: mi.Point2f) -> tuple[mi.Point2f, mi.Float]:
        """T(u) and det T(u), attached, for positions in pixels relative to the crop window."""
        u = mi.Point2f(dr.detach(u))
        if self.grid is None or self.edges is None:
            return u, mi.Float(1)
        fixed, grad_fixed = self._fixed_lines(u)
        dr.eval(u, fixed, grad_fixed)
        with dr.resume_grad():
            velocity, divergence = dr.custom(
                FilmWarp, self.edges.a, self.edges.b, self.grid, u, fixed, grad_fixed
            )
            return u + velocity, 1 + divergence

    def is_near(self, u: mi.Point2f) -> mi.Bool:
        """Whether any edge is close to the pixel that holds ``u``."""
        if self.grid is None:
            return dr.zeros(mi.Bool, dr.width(u))
        first, last = self.grid.list_at(u)
        return first < last

    def _fixed_lines(self, u: mi.Point2f) -> tuple[mi.Float, mi.Vector2f]:
        """T must keep what the frame cuts off: its lines do not move."""
        if self.film.sample_border() or self.film.rfilter().is_box_filter():
            return mi.Float(0), mi.Vector2f(0)
        size = mi.Point2f(self.film.crop_size())
        return fixed_line_weight(u, [(k, x) for k in (0, 1) for x in (mi.Float(0), size[k])], self.radius)


def _borders(
    integrator: FilmIntegrator, scene: mi.Scene, sensor: mi.Sensor, warp: Warp, seed: int, spp: int
) -> tuple[PixelBorders, list[mi.Float]] | None:
    """For the box filter, samples on pixel borders and their channels; else ``None``."""
    film = sensor.film()
    if not film.rfilter().is_box_filter():
        return None

    def sampler(size: int) -> mi.Sampler:
        result = mi.load_dict({"type": "independent"})
        result.seed(mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(1))[0], size)
        return result

    borders = PixelBorders(film, warp, max(spp // 4, 1), sampler)
    if borders.size == 0:
        return None
    draw = borders.sampler
    time = sensor.shutter_open() + draw.next_1d() * sensor.shutter_open_time()
    wavelength = draw.next_1d() if mi.is_spectral else mi.Float(0)
    samples = CameraSamples(borders.u, time, wavelength, (0, 0), (0, 0))
    return borders, _primal(integrator, scene, sensor, draw, samples)[1]


def _prepare(
    integrator: FilmIntegrator, scene: mi.Scene, sensor: int | mi.Sensor, seed: int, spp: int
) -> tuple[mi.Sensor, mi.Sampler, int, CameraSamples]:
    sensor = sensor_of(scene, sensor)
    check_sensor(sensor)
    check_meshes(scene)
    warn_once(scene, integrator.said)
    sampler, spp = integrator.prepare(sensor, seed, spp, integrator.aov_names())
    samples = CameraSamples.draw(sensor, sampler)
    dr.eval(samples.u, samples.time, samples.wavelength)
    return sensor, sampler, spp, samples


def _primal(
    integrator: FilmIntegrator,
    scene: mi.Scene,
    sensor: mi.Sensor,
    sampler: mi.Sampler,
    samples: CameraSamples,
) -> tuple[PathSample, list[mi.Float]]:
    ray, weight = samples.rays(sensor, samples.u)
    state = integrator.primal(scene, sampler.clone(), ray)
    dr.eval(state)
    channels = film_channels(sensor.film(), state.value * weight, state.alpha, state.aovs, ray.wavelengths)
    return state, channels


def render_backward(
    integrator: FilmIntegrator,
    scene: mi.Scene,
    grad_in: mi.TensorXf,
    sensor: int | mi.Sensor,
    seed: int,
    spp: int,
) -> None:
    """Adds the derivative of ``<grad_in, image>`` to the gradients of the scene's parameters."""
    with dr.suspend_grad():
        sensor, sampler, spp, samples = _prepare(integrator, scene, sensor, seed, spp)
        film = sensor.film()
        count = len(film_channels(film, mi.Spectrum(0), 0, [], mi.Color0f())) + len(integrator.aov_names())
        image_adjoint = _develop_adjoint(film, grad_in, count, integrator.aov_names())
        tables = scene_edge_tables(scene)
        warp = Warp(scene, tables, sensor, samples, integrator)
        index, traced, sampler = not_lost(integrator, scene, sensor, samples, sampler, warp, seed)
        on_values = FilmSplat(film, spp, traced.u).gather(image_adjoint)
        dr.eval(on_values)
        state = None
        if integrator.replays(scene):
            state, _ = _primal(integrator, scene, sensor, sampler, traced)
        outputs = []
        for term in integrator.boundary_terms(scene, tables, sensor, seed):
            on_jump = FilmSplat(film, 1, term.film).gather(image_adjoint)
            jump = sum(x * d for x, d in zip(term.jump, on_jump, strict=True))
            with dr.resume_grad():
                outputs.append(dr.detach(jump) * term.swept(warp))
        with dr.resume_grad():
            shifted, _ = warp(traced.u)
            ray, weight = traced.rays(sensor, shifted)

            def on_sample(value: mi.Spectrum, alpha: mi.Float, aovs: list[mi.Float]) -> mi.Float:
                channels = film_channels(film, value * weight, alpha, aovs, ray.wavelengths)
                return sum(x * d for x, d in zip(channels, on_values, strict=True))

            total, state = integrator.attached(dr.ADMode.Backward, scene, sampler, ray, state, on_sample)
            values = film_channels(
                film,
                dr.detach(state.value) * dr.detach(weight),
                dr.detach(state.alpha),
                dr.detach(state.aovs),
                ray.wavelengths,
            )
            dr.schedule(values)  # together with what the traversal evaluates
            # The edges are passed twice.
            _traverse([*outputs, total], dr.ADFlag.ClearVertices if warp.grid else dr.ADFlag.Default)
            dr.eval(values)
            if warp.grid is not None:
                values = _in_place(values, index, dr.width(samples.u))
                outputs = _outputs_of_warp(
                    integrator, scene, sensor, warp, samples, values, image_adjoint, seed, spp
                )
                _traverse(outputs, dr.ADFlag.Default)
        dr.eval()


def _outputs_of_warp(
    integrator: FilmIntegrator,
    scene: mi.Scene,
    sensor: mi.Sensor,
    warp: Warp,
    samples: CameraSamples,
    values: list[mi.Float],
    image_adjoint: list[mi.Float],
    seed: int,
    spp: int,
) -> list[mi.Float]:
    """What the warp does to samples of the given channels, weighted by the image's adjoint."""
    with dr.suspend_grad():
        splat = FilmSplat(sensor.film(), spp, samples.u, values)
        near = numbers_of(warp.is_near(samples.u))
        on_shift, on_det = splat.adjoint(image_adjoint, near)
        borders = _borders(integrator, scene, sensor, warp, seed, spp)
    shifted, det = warp(splat.take(near).u)
    outputs = [dr.dot(shifted, on_shift) + det * on_det]
    if borders is not None:
        borders, on_border = borders
        on_flux = borders.adjoint(image_adjoint, on_border, splat.mean_control())
        outputs.append(borders.flux(warp) * on_flux)
    return outputs


def _in_place(values: list[mi.Float], index: mi.UInt32 | None, count: int) -> list[mi.Float]:
    """Numbers of all samples from those of the traced ones; the others' are 0."""
    if index is None:
        return values
    result = [dr.zeros(mi.Float, count) for _ in values]
    for whole, value in zip(result, values, strict=True):
        dr.scatter(whole, value, index, mode=dr.ReduceMode.Permute)
    dr.eval(result)
    return result


def _traverse(outputs: list[mi.Float], flags: dr.ADFlag) -> None:
    """Propagates a derivative of one from each output."""
    for output in outputs:
        dr.set_grad(output, 1)
        dr.enqueue(dr.ADMode.Backward, output)
    dr.traverse(dr.ADMode.Backward, flags)


def render_forward(
    integrator: FilmIntegrator, scene: mi.Scene, sensor: int | mi.Sensor, seed: int, spp: int
) -> mi.TensorXf:
    """The derivative of the image along the tangents set on the scene's parameters."""
    with dr.suspend_grad():
        sensor, sampler, spp, samples = _prepare(integrator, scene, sensor, seed, spp)
        film = sensor.film()
        tables = scene_edge_tables(scene)
        warp = Warp(scene, tables, sensor, samples, integrator)
        index, traced, sampler = not_lost(integrator, scene, sensor, samples, sampler, warp, seed)
        state, values = _primal(integrator, scene, sensor, sampler, traced)
        boundary = list(integrator.boundary_terms(scene, tables, sensor, seed))
        borders = _borders(integrator, scene, sensor, warp, seed, spp)
        with dr.resume_grad():
            swept = [term.swept(warp) for term in boundary]
            if borders is not None:
                swept.append(borders[0].flux(warp))
            shifted, det = warp(traced.u)
            ray, weight = traced.rays(sensor, shifted)

            def on_sample(value: mi.Spectrum, alpha: mi.Float, aovs: list[mi.Float]) -> list[mi.Float]:
                return film_channels(film, value * weight, alpha, aovs, ray.wavelengths)

            tangents, (shift, divergence, *swept) = integrator.attached(
                dr.ADMode.Forward, scene, sampler, ray, state, on_sample, (shifted, det, *swept)
            )
        dr.eval(tangents, shift, divergence, swept)
        count = dr.width(samples.u)
        values, tangents, shift, [divergence] = (
            _in_place(part, index, count) for part in (values, tangents, [*shift], [divergence])
        )
        splat = FilmSplat(film, spp, samples.u, values)
        image = splat.tangent(tangents, mi.Vector2f(*shift), divergence)
        if borders is not None:
            borders[0].scatter(image, swept.pop(), borders[1], splat.mean_control())
        for term, area in zip(boundary, swept, strict=True):
            jumps = FilmSplat(film, 1, term.film).scatter([x * area for x in term.jump])
            image = [a + b for a, b in zip(image, jumps, strict=True)]
        return _develop(film, image, integrator.aov_names())
