"""What a fit has found, as objects to render and to export."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..diagnostics import diagnose
from ..light import EnvironmentLight
from ..material import GivenMaterial, MaterialField, given_material
from .joint.depth import depth_error
from .joint.joint import optimised_scene
from .stage import Fit
from .stages.joint import start_light
from .surface import Surface


@dataclass(frozen=True)
class Fitted:
    """The end of a fit; the scene's gshell shape is its surface.

    Attributes:
        material: on the surface's lattice.
        light: None if it is the scene's own.
        texture: (V, 3) base colours of the surface's mesh, divided ``texture_levels`` times; or None.
    """

    material: MaterialField | GivenMaterial
    light: EnvironmentLight | None
    texture: np.ndarray | None
    texture_levels: int

    @classmethod
    def of(cls, fit: Fit, surface: Surface) -> Fitted:
        """What a surface after the last stage stands for."""
        subject, config = fit.scene.subject, fit.config
        subject.set_fields(surface.fields)
        given, count = given_material(fit.scene.bsdf), surface.lattice.vertex_count
        if config.material_is_given:
            material = GivenMaterial(count, **given)
        else:
            material = MaterialField(np.zeros((count, 3)), **given)
            material.parameters = {name: mi.Float(surface.model[name]) for name in material.parameters}
        light, model = start_light(fit.scene, surface, config), surface.model
        return cls(material, light, model.get("texture"), int(model.get("texture_levels", 0)))

    def findings(self, fit: Fit, warn: Callable[[str], None]) -> dict:
        """Entries of ``metrics.json``: ``diagnostics`` and, with depth maps, ``depth_error``.

        Args:
            fit: the views.
            warn: called with every warning.
        """
        subject = fit.scene.subject
        surface, template = (mesh.to_numpy()[:2] for mesh in (subject.surface, subject.template()))
        found = diagnose(surface, template, fit.views, subject.cell_size)
        for warning in found.warnings():
            warn(warning)
        metrics = {"diagnostics": dataclasses.asdict(found)}
        if any(target.depth is not None for target in fit.scene.targets):
            error = depth_error(fit.scene, fit.views, optimised_scene(fit.scene, self.light))
            metrics |= {} if error is None else {"depth_error": error}
        return metrics
