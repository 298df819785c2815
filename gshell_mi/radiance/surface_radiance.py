"""A radiance on a surface: which parts of a template are surface, found without a light model.

Every vertex of the watertight template carries an opacity and one radiance per side, times what all of the
surface mirrors. A pixel's ray composites the first few layers that it meets front to back. Where the object
is open (the neck of a T-shirt, the rim of a hat) no single radiance of the template's cap agrees with what
the views see through it, so the cap fades and the inner side behind it takes over. As there is neither a
light nor a material, nothing can be traded for scale or shading, and a path tracer's noise is absent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import losses
from ..activations import inverse_softplus, sigmoid, softplus
from ..bounds import Between
from ..compat import mesh_scene, move_mesh
from ..fields.smoothing import MeshDiffusion
from ..optimizer_arrays import optimizer_arrays, restore_optimizer
from ..pixels import PixelPool, PixelSample
from ..preview import Preview
from ..template.normals import vertex_normals
from ..views import PinholeViews
from .contrast import Contrast
from .layers import Layer, interpolated, trace_layers
from .mirrored import Mirrored, mirrored_direction

#: Logit of opacity 0.35, where every vertex starts. Low enough that rays reach the layers behind, high
#: enough that all are seen; colours fitted at full opacity would bleed what is inside into the caps.
_INITIAL_LOGIT = float(np.log(0.35 / 0.65))

#: Logit of a vertex that is taken to be opaque (its negative: to be open).
_CERTAIN_LOGIT = 8.0

#: Transmittance below which nothing further along a ray is looked for.
_NEGLIGIBLE = 1e-3

#: Smoothed logits are limited to this.
_LOGIT_LIMIT = 3.0

#: Steps that adapt the radiance to a given opacity.
_REFIT_STEPS = 40

#: Refits of a radiance that has not learnt anything yet.
_ROUNDS_FROM_GREY = 3

#: Random pixels of these steps must not depend on how many training steps came before.
_EXTRA_STEP = 1 << 20


@dataclass(frozen=True)
class RadianceConfig:
    """Radiance and opacity of a template, by which openings are sought and vertices moved."""

    batch: Annotated[int, Between(1)] = 65536
    """Pixels per step over all views, of which those far from the masks are left out."""
    layers: Annotated[int, Between(1)] = 4
    """Layers of the template that a ray composites."""
    lr: float = 0.1
    """Adam's step for opacity logits and radiance."""
    smoothing: float = 2.0
    """Lambda of the Sobolev gradient (I + lambda L)^-1 on the template."""


class SurfaceRadiance:
    """Opacity and two-sided radiance on a mesh, trained on random pixels of all views.

    Args:
        vertices: (V, 3) positions, world units.
        faces: (F, 3) vertex indices, oriented outwards.
        views: the cameras.
        pixels: the targets' pixels.
        config: how it is fitted.
        seed: of the random pixels.
        mirrored: known factor of the radiance; without one it does not depend on the direction.
    """

    def __init__(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        views: PinholeViews,
        pixels: PixelPool,
        config: RadianceConfig,
        *,
        seed: int = 0,
        mirrored: Mirrored | None = None,
    ):
        self.views, self.pixels, self.config, self._mirrored = views, pixels, config, mirrored
        self.seed = seed
        self.vertex_count = len(vertices)
        self._positions = mi.Float(vertices.ravel().astype(np.float32))
        self._faces = mi.Vector3u(faces.T.astype(np.uint32))
        self.scene = mesh_scene(vertices, faces)
        self._offset = 1e-4 * float(np.ptp(vertices, axis=0).max())
        self._smooth = MeshDiffusion(faces, self.vertex_count, config.smoothing)
        self.tone = Contrast(pixels.mean_radiance())
        grey = inverse_softplus(pixels.mean_radiance())
        self.optimizer = mi.ad.Adam(lr=config.lr)
        #: (V, 2, 3): of the front and the back of every vertex.
        self.optimizer["radiance"] = dr.full(mi.Float, grey, 6 * self.vertex_count)
        if mirrored:
            self._normals = self._smooth_normals()
        self._set_opacity(np.full(self.vertex_count, _INITIAL_LOGIT))
        self._opacity_rests = False

    def begin_again(self, opaque: np.ndarray, opened: np.ndarray) -> None:
        """Before all steps once more, with the radiance of now. The vertices ``opaque`` (V,) and ``opened``
        (V,) are so at the start, and may change; the others' opacity is as it was at first."""
        known = np.where(opaque, _CERTAIN_LOGIT, -_CERTAIN_LOGIT)
        self._set_opacity(np.where(opaque | opened, known, _INITIAL_LOGIT))
        self._opacity_rests = False

    def refit_anew(self, opaque: np.ndarray) -> None:
        """Fits the radiance as ``refit`` does, but from grey."""
        for _ in range(_ROUNDS_FROM_GREY):
            self.refit(opaque)

    def refit(self, opaque: np.ndarray) -> None:
        """Fits the radiance alone, with the vertices ``opaque`` (V,) opaque and the others open."""
        self._set_opacity(np.where(opaque, _CERTAIN_LOGIT, -_CERTAIN_LOGIT))
        self._opacity_rests = True
        for step in range(_REFIT_STEPS):
            sample, radiance, _, layers = self.render(_EXTRA_STEP + step)
            # What is left of a template may be too small for any ray to meet.
            if not layers:
                continue
            dr.backward(losses.l1(self.tone(radiance), self.tone(sample.radiance)))
            self.update(("radiance",), self.config.lr)

    def move(self, positions: mi.Float) -> None:
        """Puts the vertices elsewhere: (3 V,) world positions, x0, y0, z0, x1, ..."""
        self._positions = positions
        if self._mirrored:
            self._normals = self._smooth_normals()
        move_mesh(self.scene, positions)

    def take_over(self, positions: np.ndarray, fitted: Mapping[str, np.ndarray]) -> None:
        """Goes on where another one on the same template was after a ``refit``.

        Args:
            positions: (V, 3) of the vertices.
            fitted: what its ``fitted`` gave.
        """
        self.move(mi.Float(positions.ravel()))
        self._opacity_rests = True
        restore_optimizer("radiance", self.optimizer, fitted)

    def fitted(self) -> dict[str, np.ndarray]:
        """What ``take_over`` needs."""
        return optimizer_arrays("radiance", self.optimizer)

    def _set_opacity(self, logits: np.ndarray) -> None:
        """New logits, and an optimiser without memory of what led to the old ones."""
        self.optimizer["opacity"] = mi.Float(logits.astype(np.float32))
        self.optimizer.reset()

    def render(self, step: int) -> tuple[PixelSample, mi.Color3f, mi.Float, list[Layer]]:
        """The random pixels of a step, their radiance and coverage, and the layers behind them."""
        sample, layers = self.look(step)
        radiance, alpha = self.composite(layers, sample.view)
        # Each of the losses would do this again.
        dr.eval(radiance, alpha)
        return sample, radiance, alpha, layers

    def look(self, step: int) -> tuple[PixelSample, list[Layer]]:
        """The random pixels of a step, and the layers that the rays through them meet."""
        sample = self.pixels.sample(self.config.batch, seed=self.seed, step=step)
        return sample, self._layers(self.views.rays(sample.view, sample.film))

    def update(self, names: tuple[str, ...], rate: float) -> None:
        """Steps the parameters ``names``; the others rest.

        Values of the vertices move along their Sobolev gradients.
        """
        rates = dict.fromkeys(("opacity", "radiance"), 0.0) | dict.fromkeys(names, rate)
        gradients = {name: dr.grad(self.optimizer[name]) for name, value in rates.items() if value}
        gradients = self._smooth.together(gradients)
        for name in rates:
            parameter = self.optimizer[name]
            dr.set_grad(parameter, gradients.get(name, dr.zeros(mi.Float, dr.width(parameter))))
        self.optimizer.set_learning_rate(rates)
        self.optimizer.step()

    def smoothed_logits(self) -> np.ndarray:
        """(V,) opacity logits, smoothed along the mesh; the surface is where they are positive.

        Only their sign is meant, so they are limited first: a very sure vertex must not outvote its
        neighbours when the rim is drawn between them.
        """
        limited = dr.minimum(dr.maximum(dr.detach(self.optimizer["opacity"]), -_LOGIT_LIMIT), _LOGIT_LIMIT)
        return self._smooth(limited).numpy()

    def radiance(self) -> tuple[np.ndarray, np.ndarray]:
        """(V, 3) front and back radiance."""
        return tuple(softplus(self.optimizer["radiance"]).numpy().reshape(-1, 2, 3).swapaxes(0, 1))

    def preview(self) -> Preview:
        """The part of the mesh that is not clearly fading, in the radiance of its front."""
        vertices, faces = self._positions.numpy().reshape(-1, 3), self._faces.numpy().T
        kept = dr.detach(self.optimizer["opacity"]).numpy() > 2 * _INITIAL_LOGIT
        return Preview(vertices, faces[kept[faces].all(axis=1)], self.radiance()[0], vertices, faces)

    def sides(self) -> tuple[mi.Color3f, mi.Color3f]:
        """Of every vertex, what the softplus makes radiance of: front and back."""
        vertex = dr.arange(mi.UInt32, self.vertex_count)
        return tuple(
            dr.gather(mi.Color3f, self.optimizer["radiance"], 2 * vertex + side, mode=dr.ReduceMode.Permute)
            for side in range(2)
        )

    def _layers(self, ray: mi.Ray3f) -> list[Layer]:
        """The first layers along each ray.

        There are none behind layers that let nothing through, unless their opacity is still to be found: for
        that, what they hide counts as well.
        """
        opacity, transmittance = dr.detach(self.optimizer["opacity"]), dr.full(mi.Float, 1, dr.width(ray.d))

        def goes_on(layer: Layer) -> mi.Bool:
            nonlocal transmittance
            remaining = dr.gather(mi.Float, transmittance, layer.lane)
            transmittance = remaining * (1 - sigmoid(layer.interpolate(opacity)))
            dr.eval(transmittance)
            return transmittance > _NEGLIGIBLE

        return trace_layers(
            self.scene,
            self._positions,
            self._faces,
            ray,
            self.config.layers,
            self._offset,
            goes_on if self._opacity_rests else None,
        )

    def composite(self, layers: list[Layer], view: mi.UInt32) -> tuple[mi.Color3f, mi.Float]:
        """Compositing (Porter and Duff 1984, *over*) of radiance and coverage.

        Args:
            layers: what the rays meet, from ``look``.
            view: index of the view that each of the rays is of.

        Returns:
            Radiance and coverage of every ray.
        """
        opacity = self.optimizer["opacity"]
        if self._opacity_rests:
            opacity = dr.detach(opacity)  # its derivatives would take as long as those of the radiance
        radiance, transmittance = mi.Color3f(0), mi.Float(1)
        # Each layer has lanes of its own.
        views = [view]
        for layer in layers:
            views.append(dr.gather(mi.UInt32, views[-1], layer.lane))
        for layer, of_layer, in_front in reversed(list(zip(layers, views[1:], views, strict=False))):
            width = dr.width(in_front)
            sides = [layer.side(corner) for corner in layer.face]
            color = interpolated(mi.Color3f, self.optimizer["radiance"], sides, layer.weights)
            color = softplus(color)
            if self._mirrored:
                mirrored = mirrored_direction(dr.normalize(layer.direction), self._normal(layer))
                color *= self._mirrored.factor(self.views.in_surroundings(of_layer, mirrored))
            alpha = sigmoid(layer.interpolate(opacity))
            radiance = _spread(dr.lerp(radiance, color, alpha), layer.lane, 0, width)
            transmittance = _spread((1 - alpha) * transmittance, layer.lane, 1, width)
        return radiance, 1 - transmittance

    def _normal(self, layer: Layer) -> mi.Vector3f:
        """Smooth normals at hits, of any length."""
        # What depends on the view is to explain highlights, not to turn the surface.
        return interpolated(mi.Vector3f, self._normals, layer.face, dr.detach(layer.weights))

    def _smooth_normals(self) -> mi.Float:
        """(3 V,) unit normals, as smooth as the other values at the vertices."""
        normals = dr.unravel(mi.Vector3f, self._smooth(vertex_normals(self._positions, self._faces)))
        return dr.ravel(normals / dr.maximum(dr.norm(normals), 1e-12))


def _spread(values, lane: mi.UInt32, rest: float, count: int):
    """``values`` on their lanes of ``count``, and ``rest`` on all others."""
    target = dr.full(type(values), rest, count)
    dr.scatter(target, values, lane, mode=dr.ReduceMode.Permute)
    return target
