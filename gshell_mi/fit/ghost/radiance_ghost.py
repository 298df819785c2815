"""The radiance ghost: which parts of a template are surface, found without a light model.

Every vertex of the watertight template carries an opacity and one radiance per side; a glossy lobe that all
share adds what depends on the view. A pixel's ray
composites the first few sheets that it meets front to back. Where the object is open (the neck of a
T-shirt, the rim of a hat) no single radiance of the template's cap agrees with what the views see
through it, so the cap fades and the inner side behind it takes over. As there is neither a light nor a
material, nothing can be traded for scale or shading, and a path tracer's noise is absent.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import losses
from ...activations import inverse_softplus, sigmoid, softplus
from ...compat import mesh_scene, move_mesh
from ...fields.smoothing import MeshDiffusion
from ...images import decibels
from ...means import mean
from ...schedules import decay_at
from ...views import PinholeViews
from ..bookkeeping.observer import Preview
from ..config import FitConfig
from .contrast import Contrast
from .glossy_lobe import PER_VERTEX, SHARED, initial_lobe, mirrored_radiance
from .mesh_normals import vertex_normals
from .pixels import COVERED, PixelPool, PixelSample

#: Logit of opacity 0.35, where every vertex starts. Low enough that rays reach the sheets behind, high
#: enough that all are seen; colours fitted at full opacity would bleed what is inside into the caps.
_INITIAL_LOGIT = float(np.log(0.35 / 0.65))

#: Logit of a vertex that is taken to be opaque (its negative: to be open).
_CERTAIN_LOGIT = 8.0

#: Transmittance below which nothing further along a ray is looked for.
_NEGLIGIBLE = 1e-3

#: Smoothed logits are limited to this.
_LOGIT_LIMIT = 3.0

#: Steps that adapt the radiance to a given opacity, and steps that then measure the image error.
_REFIT_STEPS, _ERROR_STEPS = 40, 20

#: Refits of a ghost that has not learnt anything yet.
_ROUNDS_FROM_GREY = 3

#: Random pixels of these steps must not depend on how many training steps came before.
_EXTRA_STEP = 1 << 20

#: The lobe learns slower than the radiance by this factor: it is to explain what that cannot.
_LOBE_RATE = 0.4

SIDES = ("front", "back")


class RadianceGhost:
    """Opacity and two-sided radiance on a fixed mesh, trained on random pixels of all views.

    Args:
        vertices: (V, 3) positions, world units.
        faces: (F, 3) vertex indices, oriented outwards.
        views: the cameras.
        pixels: the targets' pixels.
        config: ``ghost_*`` fields.
        glossy: adds the lobe, for shapes. Openings are told apart better without: it explains a little of
            everything, hence also of what is seen through a cap.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, views: PinholeViews, pixels: PixelPool,
                 config: FitConfig, *, glossy: bool = False):
        self.views, self.pixels, self.config, self.glossy = views, pixels, config, glossy
        self.vertex_count = len(vertices)
        self._positions = mi.Float(vertices.ravel().astype(np.float32))
        self._faces = mi.Vector3u(faces.T.astype(np.uint32))
        self.scene = mesh_scene(vertices, faces)
        self._offset = 1e-4 * float(np.ptp(vertices, axis=0).max())
        self._smooth = MeshDiffusion(faces, self.vertex_count, config.ghost_smoothing)
        self._tone = Contrast(pixels.mean_radiance())
        grey = inverse_softplus(pixels.mean_radiance())
        self.optimizer = mi.ad.Adam(lr=config.ghost_lr)
        for side in SIDES:
            self.optimizer[side] = dr.full(mi.Float, grey, 3 * self.vertex_count)
        if glossy:
            for name, values in initial_lobe(self.vertex_count, pixels.mean_radiance()).items():
                self.optimizer[name] = values
            self._normals = self._smooth_normals()
        self._set_opacity(np.full(self.vertex_count, _INITIAL_LOGIT))
        self._opacity_rests = False

    def step(self, iteration: int) -> dict[str, float]:
        """One Adam step on a batch of random pixels; returns the losses."""
        config, optimizer = self.config, self.optimizer
        progress = iteration / config.ghost_iterations
        sample, radiance, alpha, _ = self._render(iteration)
        image = losses.l1(self._tone(radiance), self._tone(sample.radiance))
        mask = losses.mask_l2(alpha, sample.alpha)
        # Where a mask shows daylight within the hull, every sheet on the ray is open: no doubt, no balance.
        daylight = losses.mask_l2(dr.select(sample.alpha < 0.01, alpha, 0), 0)
        opacity = sigmoid(optimizer["opacity"])
        front, back = (dr.unravel(mi.Color3f, softplus(optimizer[side])) for side in SIDES)
        # Undecided opacity must have its say first; only then is it made to decide.
        late = dr.opaque(mi.Float, max(0.0, 2 * progress - 1))
        total = (
            image
            + self.pixels.mask_weight(config.ghost_mask) * mask
            + self.pixels.mask_weight(config.ghost_daylight) * daylight
            + late * config.ghost_binary * losses.binary_entropy_bound(opacity)
            + late * config.ghost_closing * losses.transparency(opacity)
            + config.ghost_chroma * losses.chroma_difference(front, back)
        )
        dr.backward(total)
        self.update(("opacity", *SIDES), config.ghost_lr * decay_at(progress))
        error = mean(dr.square(dr.detach(radiance) - sample.radiance))
        return {"loss": total[0], "image": image[0], "mask": mask[0],
                "psnr": decibels(error[0])}

    def refit_anew(self, opaque: np.ndarray) -> None:
        """Fits the radiance as ``refit`` does, but from grey to where errors compare."""
        for _ in range(_ROUNDS_FROM_GREY):
            self.refit(opaque)

    def refit(self, opaque: np.ndarray) -> None:
        """Fits the radiance alone, with the vertices ``opaque`` (V,) opaque and the others open."""
        self._set_opacity(np.where(opaque, _CERTAIN_LOGIT, -_CERTAIN_LOGIT))
        self._opacity_rests = True
        for step in range(_REFIT_STEPS):
            sample, radiance, _, _ = self._render(_EXTRA_STEP + step)
            dr.backward(losses.l1(self._tone(radiance), self._tone(sample.radiance)))
            self.update(SIDES, self.config.ghost_lr)

    def image_error(self, opaque: np.ndarray) -> np.ndarray:
        """How badly the images are explained through each vertex if just the vertices ``opaque`` are.

        Returns:
            (2, V) sums of the image error over random rays by the vertices of the *first* sheet that they
            meet, whether that sheet is opaque or not: over all pixels, and over those that are wholly
            covered. Sums for different opacities run over the same rays, hence they compare patch by patch.
        """
        self.refit(opaque)
        sums = [dr.zeros(mi.Float, self.vertex_count) for _ in range(2)]
        with dr.suspend_grad():
            for step in range(_ERROR_STEPS):
                sample, radiance, _, sheets = self._render(_EXTRA_STEP + _REFIT_STEPS + step)
                difference = dr.abs(self._tone(radiance) - self._tone(sample.radiance))
                hit, face, weights, _ = sheets[0]
                for total, counts in zip(sums, (hit, hit & (sample.alpha > COVERED)), strict=True):
                    for corner in range(3):
                        share = weights[corner] * (difference.x + difference.y + difference.z)
                        dr.scatter_reduce(dr.ReduceOp.Add, total, share, face[corner], counts)
                dr.eval(sums)
        return np.stack([total.numpy() for total in sums])

    def unexplained(self, pixels: PixelPool) -> float:
        """Mean image loss on other pixels than those that the ghost was trained on."""
        total = mi.Float(0)
        with dr.suspend_grad():
            for step in range(_ERROR_STEPS):
                sample = pixels.sample(self.config.ghost_batch, seed=self.config.seed, step=step)
                ray = self.views.rays(sample.view, sample.film)
                radiance, _ = self.composite(self.sheets(ray), ray.d)
                total += losses.log_l1(radiance, sample.radiance)
                dr.eval(total)
        return float(total[0]) / _ERROR_STEPS

    def move(self, positions: mi.Float) -> None:
        """Puts the vertices elsewhere: (3 V,) world positions, x0, y0, z0, x1, ..."""
        self._positions = positions
        if self.glossy:
            self._normals = self._smooth_normals()
        move_mesh(self.scene, positions)

    def _set_opacity(self, logits: np.ndarray) -> None:
        """New logits, and an optimiser without memory of what led to the old ones."""
        self.optimizer["opacity"] = mi.Float(logits.astype(np.float32))
        self.optimizer.reset()

    def _render(self, step: int) -> tuple:
        """The random pixels of a step, their radiance and coverage, and the sheets behind them."""
        sample, ray, sheets = self.look(step)
        radiance, alpha = self.composite(sheets, ray.d)
        # Each of the losses would do this again.
        dr.eval(radiance, alpha)
        return sample, radiance, alpha, sheets

    def look(self, step: int) -> tuple[PixelSample, mi.Ray3f, list[tuple]]:
        """The random pixels of a step, the rays through them and the sheets that these meet."""
        sample = self.pixels.sample(self.config.ghost_batch, seed=self.config.seed, step=step)
        ray = self.views.rays(sample.view, sample.film)
        return sample, ray, self.sheets(ray)

    def update(self, names: tuple[str, ...], rate: float) -> None:
        """Steps the parameters ``names`` and the lobe; the others rest.

        Values of the vertices move along their Sobolev gradients.
        """
        rates = dict.fromkeys(("opacity", *SIDES), 0.0) | dict.fromkeys(names, rate)
        if self.glossy:
            rates |= dict.fromkeys((*PER_VERTEX, *SHARED), _LOBE_RATE * rate)
        gradients = {name: dr.grad(self.optimizer[name]) for name, value in rates.items() if value}
        gradients |= self._smooth.together({name: gradient for name, gradient in gradients.items()
                                            if name not in SHARED})
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
        return tuple(softplus(self.optimizer[side]).numpy().reshape(-1, 3) for side in ("front", "back"))

    def preview(self) -> Preview:
        """The part of the mesh that is not clearly fading, in the radiance of its front."""
        vertices, faces = self._positions.numpy().reshape(-1, 3), self._faces.numpy().reshape(-1, 3)
        kept = dr.detach(self.optimizer["opacity"]).numpy() > 2 * _INITIAL_LOGIT
        return Preview(vertices, faces[kept[faces].all(axis=1)], self.radiance()[0], vertices, faces)

    def sheets(self, ray: mi.Ray3f) -> list[tuple]:
        """The first sheets along each ray: (hit?, vertex indices, barycentric weights, front side?).

        There are none behind sheets that let nothing through, unless their opacity is still to be found: for
        that, what they hide counts as well.
        """
        sheets = []
        opacity = dr.detach(self.optimizer["opacity"])
        active, transmittance = dr.full(mi.Bool, True, dr.width(ray.o)), mi.Float(1)
        for _ in range(self.config.ghost_sheets):
            hit = self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            active = hit.is_valid()
            face = mi.Vector3u(*(dr.gather(mi.UInt32, corner, hit.prim_index, active)
                                 for corner in self._faces))
            a, b, c = (dr.gather(mi.Point3f, self._positions, face[i], active) for i in range(3))
            front = dr.dot(dr.cross(b - a, c - a), ray.d) < 0
            # Barycentrics of a miss are not a number, and 0 times that is no 0.
            uv = dr.select(active, hit.prim_uv, 0)
            weights = mi.Vector3f(1 - uv.x - uv.y, uv.x, uv.y)
            sheets.append((active, face, weights, front))
            transmittance *= 1 - sigmoid(_interpolated(opacity, face, weights, active))
            if self._opacity_rests:
                active = active & (transmittance > _NEGLIGIBLE)
            ray = mi.Ray3f(ray.o + ray.d * dr.select(active, hit.t + self._offset, 0), ray.d)
        dr.eval(sheets)
        return sheets

    def composite(self, sheets: list[tuple], direction: mi.Vector3f) -> tuple[mi.Color3f, mi.Float]:
        """Front-to-back compositing (Porter and Duff 1984, *over*) of radiance and coverage.

        Args:
            sheets: what the rays meet, from ``look``.
            direction: of the rays.
        """
        opacity = self.optimizer["opacity"]
        if self._opacity_rests:
            opacity = dr.detach(opacity)  # its derivatives would take as long as those of the radiance
        radiance, transmittance = mi.Color3f(0), mi.Float(1)
        for sheet in sheets:
            hit, face, weights, is_front = sheet
            logit, color = _interpolated(opacity, face, weights, hit), mi.Color3f(0)
            for weight, corner in zip(weights, face, strict=True):
                for side, seen in zip(SIDES, (hit & is_front, hit & ~is_front), strict=True):
                    color += weight * dr.gather(mi.Color3f, self.optimizer[side], corner, seen)
            alpha = dr.select(hit, sigmoid(logit), 0)
            color = softplus(color)
            if self.glossy:
                color += self._mirrored(sheet, direction)
            radiance += transmittance * alpha * color
            transmittance *= 1 - alpha
        return radiance, 1 - transmittance

    def _mirrored(self, sheet: tuple, direction: mi.Vector3f) -> mi.Color3f:
        """What the lobe adds to the radiance of a sheet."""
        hit, face, weights, is_front = sheet
        gloss, normal = mi.Float(0), mi.Vector3f(0)
        for weight, corner in zip(weights, face, strict=True):
            for side, seen in zip(PER_VERTEX, (hit & is_front, hit & ~is_front), strict=True):
                gloss += weight * dr.gather(mi.Float, self.optimizer[side], corner, seen)
            # The lobe is to explain highlights, not to turn the surface.
            normal += dr.detach(weight) * dr.gather(mi.Vector3f, self._normals, corner, hit)
        length = dr.norm(normal)
        normal = dr.select(length > 1e-3, normal / length, -direction)
        return mirrored_radiance(self.optimizer, gloss, dr.select(is_front, normal, -normal), direction, hit)

    def _smooth_normals(self) -> mi.Float:
        """(3 V,) unit normals, as smooth as the other values at the vertices."""
        normals = dr.unravel(mi.Vector3f, self._smooth(vertex_normals(self._positions, self._faces)))
        return dr.ravel(normals / dr.maximum(dr.norm(normals), 1e-12))


def _interpolated(values: mi.Float, face: mi.Vector3u, weights: mi.Vector3f, active: mi.Bool) -> mi.Float:
    """One value per vertex at the points that the barycentric weights give."""
    return sum(weight * dr.gather(mi.Float, values, corner, active)
               for weight, corner in zip(weights, face, strict=True))
