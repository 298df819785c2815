"""What the joint stage starts from: fields, material and light, of the scene and of the earlier stages."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..errors import UserError
from ..fields import LatticeFields
from ..light import EnvironmentLight
from ..material import GivenMaterial, MaterialField, given_material
from ..scene import FitScene
from .config import FitConfig

#: Median reflectance that the first split of radiance into material and light assumes.
TYPICAL_REFLECTANCE = 0.5


def check_given(scene: FitScene, config: FitConfig) -> None:
    """Whether the scene gives what the modes of the fit take from it.

    Raises:
        UserError: the material is to be kept, but there is none.
    """
    if config.material_is_given and not given_material(scene.bsdf):
        mode = "--geometry-only" if config.geometry_only else "--fixed-material"
        raise UserError(f"{mode} keeps the material of the gshell shape, but '{scene.path}' gives it no "
                        f"uniform one; nest a <bsdf type=\"principled\"> with base_color, roughness and "
                        f"metallic.")


def start_fields(arrays: Mapping[str, np.ndarray], grid: str) -> LatticeFields:
    """The fields that the earlier stages left."""
    deform = arrays.get("deform", np.zeros(3 * arrays["sdf"].size, np.float32))
    return LatticeFields(arrays["sdf"], arrays["msdf"], deform, grid=grid)


def start_material(scene: FitScene, arrays: Mapping[str, np.ndarray],
                   config: FitConfig) -> MaterialField | GivenMaterial:
    """The scene's own material or, as a field, what is known of it and the colours that the ghost saw."""
    given = given_material(scene.bsdf)
    if config.material_is_given:
        return GivenMaterial(len(arrays["known"]), **given)
    seen = arrays["radiance"] / arrays["light"]
    reflectance = np.where(arrays["known"][:, None], seen, TYPICAL_REFLECTANCE)
    return MaterialField(reflectance, **given)


def start_light(scene: FitScene, arrays: Mapping[str, np.ndarray],
                config: FitConfig) -> EnvironmentLight | None:
    """The map to optimise: the scene's, or an even one as bright as the object; None keeps the scene's."""
    if config.light_is_given:
        return None
    return (EnvironmentLight.from_emitter(scene.light, config.light_height)
            or EnvironmentLight.uniform(config.light_height, float(arrays["light"])))
