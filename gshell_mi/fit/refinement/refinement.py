"""Photometric refinement: the template's vertices move to where one radiance explains all images.

A visual hull bridges every fold and every hollow. There the views disagree on the radiance of a point, as
they see different points of the object through it. Derivatives of the interpolated radiance with respect to
the vertices pull the surface to where the views agree; a Sobolev gradient carries whole regions along,
which a pixel's own derivative would not reach. As in the openings stage there is neither light nor
material, hence no noise, and a step looks at all views at once.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import losses
from ...fields.smoothing import MeshDiffusion
from ...images import decibels
from ...means import mean
from ...outliers import trusted
from ...preview import Preview
from ...radiance.layers import Layer
from ...radiance.surface_radiance import SurfaceRadiance
from ...schedules import falling
from ...template.outlines import Outlines
from ...triangles import face_areas

if TYPE_CHECKING:
    from ..stages.refinement import RefinementConfig

#: Views whose outlines a step compares.
_OUTLINE_VIEWS = 8

#: Multiple of their mean size that no derivative exceeds in a step; small, as it takes many to move a region.
_OUTLIER = 10.0

#: Steps after which the Sobolev gradient is factorised with the lambda of the day.
_FACTORISE_EVERY = 64


class PhotometricRefinement:
    """Adam on the vertex positions and the radiance of a surface whose opacity rests.

    Args:
        appearance: fitted, with its opacity decided.
        vertices: (V, 3) world positions to start from.
        faces: (F, 3) of the watertight template.
        outlines: the masks; None if the targets have none.
        length: side of a lattice cell, world units.
        config: of the round.
        seed: of the views whose outlines a step compares.
    """

    def __init__(
        self,
        appearance: SurfaceRadiance,
        vertices: np.ndarray,
        faces: np.ndarray,
        outlines: Outlines | None,
        length: float,
        config: RefinementConfig,
        seed: int = 0,
    ):
        self.appearance, self.faces, self.outlines, self.config = appearance, faces, outlines, config
        self.seed = seed
        self.length = length
        area = face_areas(vertices, faces).sum()
        #: Vertices per square cell: what turns a lambda of cells into one of edges.
        self._density = len(vertices) * length**2 / area
        # One step size for all vertices: what little noise moves must not move as far as the rest.
        self.optimizer = mi.ad.Adam(lr=length, beta_2=0.99, uniform=True)
        self.optimizer["positions"] = mi.Float(vertices.ravel().astype(np.float32))
        self._diffuse = None

    def step(self, iteration: int) -> dict[str, float]:
        """One step on random pixels of all views; returns the losses."""
        config, appearance, optimizer = self.config, self.appearance, self.optimizer
        progress = iteration / config.iterations
        positions = optimizer["positions"]
        appearance.move(dr.detach(positions))
        sample, layers = appearance.look(iteration)
        attached = [replace(layer, weights=_barycentric(positions, layer)) for layer in layers]
        radiance, _ = appearance.composite(attached, sample.view)
        share = appearance.pixels.share
        image = share * losses.log_l1(radiance, sample.radiance)
        total, outline = image, mi.Float(0)
        if self.outlines:
            chosen = np.random.default_rng((self.seed, iteration)).permutation(len(appearance.views))
            outline = self.outlines.loss(positions, appearance.scene, chosen[:_OUTLINE_VIEWS])
            outline = outline / self.length**2
            # Silhouettes lead at first, while the radiance is still that of the wrong place.
            total = total + dr.opaque(mi.Float, (1 - progress / 2) * config.outline) * outline
        dr.backward(total)
        self._move(progress, iteration)
        appearance.update(("radiance",), config.radiance_lr)
        error = share * mean(dr.square(dr.detach(radiance) - sample.radiance))
        return {"loss": total[0], "image": image[0], "outline": outline[0], "psnr": decibels(error[0])}

    def positions(self) -> np.ndarray:
        """(V, 3) world positions."""
        return self.optimizer["positions"].numpy().reshape(-1, 3)

    def preview(self) -> Preview:
        """The surface, where it is now."""
        return self.appearance.preview()

    def _move(self, progress: float, iteration: int) -> None:
        config, optimizer = self.config, self.optimizer
        if self._diffuse is None or iteration % _FACTORISE_EVERY == 0:
            start = (iteration - iteration % _FACTORISE_EVERY) / config.iterations
            smoothing = falling(config.smoothing, config.detail, start)
            self._diffuse = MeshDiffusion(self.faces, self.appearance.vertex_count, self._density * smoothing)
        gradient = trusted(dr.grad(optimizer["positions"]), _OUTLIER)
        dr.set_grad(optimizer["positions"], self._diffuse(gradient))
        decay = 0.5 * (1 + np.cos(np.pi * progress))
        optimizer.set_learning_rate({"positions": decay * config.lr * self.length})
        optimizer.step()


def _barycentric(positions: mi.Float, layer: Layer) -> mi.Vector3f:
    """The weights of the rays' hits, attached to the triangles' vertices (Möller and Trumbore 1997)."""
    a, b, c = (dr.gather(mi.Point3f, positions, corner) for corner in layer.face)
    ab, ac, to_origin = b - a, c - a, layer.origin - a
    across = dr.cross(layer.direction, ac)
    determinant = dr.dot(ab, across)
    usable = dr.abs(dr.detach(determinant)) > 1e-12
    scale = dr.rcp(dr.select(usable, determinant, 1))
    u = dr.select(usable, dr.dot(to_origin, across) * scale, 0)
    v = dr.select(usable, dr.dot(layer.direction, dr.cross(to_origin, ab)) * scale, 0)
    u, v = dr.replace_grad(layer.weights.y, u), dr.replace_grad(layer.weights.z, v)
    return mi.Vector3f(1 - u - v, u, v)
