"""Texture: base colours as fine as the images, on the surface as it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import mitsuba as mi
import numpy as np

from ...bounds import Between
from ...material import attributes_of
from ...subdivision import subdivided
from ...triangles import unit, vertex_areas
from ..fitted import Fitted
from ..joint.back_projection import BackProjection, FineMesh
from ..joint.joint import other_objects
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface

#: Triangles are split at most so often.
_LEVELS = 3


@dataclass(frozen=True)
class TextureConfig:
    """Base colours as fine as the images."""

    rounds: Annotated[int, Between(0)] = 2
    """How often every view is rendered to tell the colours; 0 leaves them to the lattice's vertices."""


class Texture:
    """Gives the surface the base colours that all views together ask for."""

    name = "texture"

    def __init__(self, config: TextureConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with colours at the vertices of its mesh, as often divided as the images are fine."""
        if not surface.model or fit.config.material_is_given:
            return surface
        fitted = Fitted.of(fit, surface)
        mesh = fit.scene.subject.surface
        vertices, faces, _ = mesh.to_numpy()
        if not len(faces):
            return surface
        levels = _levels(vertices, faces, fit)
        normals = np.array(mesh.vertex_normals().numpy()).T
        attributes = attributes_of(fitted.material, mesh) | {"normal": normals}
        vertices, faces, fine = subdivided(vertices, faces, attributes, levels)
        start = FineMesh(
            vertices,
            faces,
            unit(fine["normal"]),
            fine["vertex_color"],
            fine["vertex_roughness"],
            fine["vertex_metallic"],
        )
        light, turns = fitted.light, fit.views.turns
        lights = [] if turns is None or light is None else [light.turned(turn) for turn in turns]
        work = BackProjection(
            start,
            other_objects(fit.scene, fitted.light),
            fit.scene.sensors,
            fit.views,
            fit.scene.targets,
            lights,
            steps.kept,
            seed=fit.config.seed,
        )
        steps.run(work, self.config.rounds * len(fit.views), {}, work.state)
        return replace(
            surface, model={**surface.model, "texture": work.colors(), "texture_levels": np.array(levels)}
        )


def _levels(vertices: np.ndarray, faces: np.ndarray, fit: Fit) -> int:
    """How often triangles are to be split so that there is about one vertex per pixel, and no more."""
    views = fit.views
    centre = mi.Point3f(*vertices.mean(axis=0).tolist())
    index = mi.UInt32(np.arange(len(views), dtype=np.uint32))
    pixel = float(np.median((views.project(index, centre)[1] * views.pixel_size(index)).numpy()))
    per_vertex = vertex_areas(vertices, faces).sum() / pixel**2 / len(vertices)
    return int(np.clip(np.floor(0.5 * np.log2(max(per_vertex, 1))), 0, _LEVELS))
