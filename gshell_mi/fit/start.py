"""What the joint stage starts from: fields, material and light, of the scene and of the earlier stages."""

from __future__ import annotations

from collections.abc import Mapping

import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..fields import LatticeFields
from ..fields.interpolation import Interpolation
from ..lattice import BlockLattice, Lattice, lattice_of, make_lattice
from ..light import EnvironmentLight
from ..material import GivenMaterial, MaterialField, given_material
from ..scene import FitScene
from .config import FitConfig
from .cut.recut import recut

#: Median reflectance that the first split of radiance into material and light assumes.
TYPICAL_REFLECTANCE = 0.5

#: Share of the surrounding vertices that have a radiance, from which a point between them has one.
_KNOWN = 0.1

_BAND = "band/"

#: The kind of lattice where neither scene nor settings name one. Of equally many cells FlexiCubes come out
#: nearest to the truth, with the smoothest rims and a third of the vertices of tetrahedra (docs/grids.md).
_GRID = "flexicubes"

#: Openings and hollows are found on tetrahedra, whose templates have vertices enough for that.
EARLY_GRIDS = {"tet": "tet", "cube": "tet", "flexicubes": "tet", "bcc": "bcc"}


def fit_lattice(subject: mi.Shape, config: FitConfig) -> Lattice:
    """The lattice that a fit ends on; the stages before the joint one may have fewer cells."""
    given = subject.lattice
    grid = config.grid or (given.grid if subject.grid_is_given else _GRID)
    return make_lattice(grid, config.resolution or given.resolution)


def volume_lattice(lattice: Lattice, config: FitConfig) -> Lattice:
    """The lattice that a fit ends on that starts from a radiance volume: what the settings name, or fine
    enough for what such a volume shows."""
    return make_lattice(lattice.grid, config.resolution or max(lattice.resolution, config.volume_resolution))


def check_given(scene: FitScene, config: FitConfig) -> None:
    """Whether the scene gives what the modes of the fit take from it.

    Raises:
        UserError: the material is to be kept, but there is none; the given fields hold no surface; or there
            is a second emitter.
    """
    others = [emitter.id() for emitter in scene.scene.emitters() if emitter.id() != "light"]
    if others:
        raise UserError(f"Scene '{scene.path}' has another emitter beside 'light' ('{others[0]}'); a fit "
                        f"explains the images by one environment: take it out, and its light is found as "
                        f"part of that.")
    if scene.subject.surface.is_empty:
        raise UserError(f"The fields '{scene.subject.filename}' of the gshell shape hold no surface; leave "
                        f"'filename' out of '{scene.path}' or give others.")
    if config.material_is_given and not given_material(scene.bsdf):
        mode = "--geometry-only" if config.geometry_only else "--fixed-material"
        raise UserError(f"{mode} keeps the material of the gshell shape, but '{scene.path}' gives it no "
                        f"uniform one; nest a <bsdf type=\"principled\"> with base_color, roughness and "
                        f"metallic.")


def start_fields(subject: mi.Shape, arrays: Mapping[str, np.ndarray], lattice: Lattice,
                 config: FitConfig) -> LatticeFields:
    """The fields that earlier stages left, or a checkpoint of the joint stage in blocks, on ``lattice``; the
    shape is left with any."""
    if f"{_BAND}blocks" in arrays:
        stored = {name: arrays[f"{_BAND}{name}"] for name in ("sdf", "msdf", "deform", "blocks")}
        return LatticeFields(**stored, grid=lattice.grid, block_resolution=lattice.resolution)
    deform = arrays.get("deform", np.zeros(3 * arrays["sdf"].size, np.float32))
    fields = LatticeFields(arrays["sdf"], arrays["msdf"], deform, grid=lattice.grid)
    in_blocks = lattice.resolution >= config.band_resolution and lattice.fits_in_blocks
    if fields.lattice == lattice:
        return fields.in_blocks() if in_blocks else fields
    resample = fields.in_blocks if in_blocks else fields.to_lattice
    return recut(subject, fields, resample(lattice.resolution))


def block_arrays(fields: LatticeFields) -> dict[str, np.ndarray]:
    """What a checkpoint keeps of fields in blocks, for ``start_fields``; nothing of others."""
    if fields.blocks is None:
        return {}
    return {f"{_BAND}{name}": getattr(fields, name) for name in ("sdf", "msdf", "deform", "blocks")}


def start_material(scene: FitScene, arrays: Mapping[str, np.ndarray], lattice: Lattice | BlockLattice,
                   config: FitConfig) -> MaterialField | GivenMaterial:
    """The scene's own material or, as a field, what a joint stage has left of it, or what is known of it and
    the colours that the ghost saw."""
    given = given_material(scene.bsdf)
    if config.material_is_given:
        return GivenMaterial(lattice.vertex_count, **given)
    if "vertex_color" in arrays:
        return _resampled_material(arrays, lattice)
    radiance, known = arrays["radiance"], arrays["known"]
    seen_on = lattice_of(lattice.grid, len(known))
    if seen_on != lattice:
        points = lattice.points(mi.Float)
        share = Interpolation(mi.Float(known.astype(np.float32)), seen_on)(points).numpy()
        # Where nothing is known the radiance is 0.
        total = Interpolation(mi.Float(radiance.astype(np.float32).ravel()), seen_on)(points).numpy()
        known = share > _KNOWN
        radiance = total.reshape(-1, 3) / np.maximum(share, _KNOWN)[:, None]
    seen = radiance / arrays["light"]
    if config.even_start and not config.light_is_given and known.any():
        seen = np.broadcast_to(np.median(seen[known], axis=0), seen.shape)
    reflectance = np.where(known[:, None], seen, TYPICAL_REFLECTANCE)
    return MaterialField(reflectance, **given)


def _resampled_material(arrays: Mapping[str, np.ndarray], lattice: Lattice | BlockLattice) -> MaterialField:
    """The material that a joint stage has left on another lattice."""
    before = lattice_of(lattice.grid, arrays["sdf"].size)
    points = lattice.points(mi.Float)
    material = MaterialField(np.full((lattice.vertex_count, 3), TYPICAL_REFLECTANCE))
    material.parameters = {name: mi.Float(arrays[name]) for name in material.parameters}
    for name in material.on_lattice:
        material.parameters[name] = Interpolation(material.parameters[name], before)(points)
    return material


def start_light(scene: FitScene, arrays: Mapping[str, np.ndarray],
                config: FitConfig) -> EnvironmentLight | None:
    """The map to optimise: what a joint stage has left, the scene's, or an even one as bright as the object;
    None keeps the scene's."""
    if config.light_is_given:
        return None
    light = (EnvironmentLight.from_emitter(scene.light, config.light_height)
             or EnvironmentLight.uniform(config.light_height, float(arrays["light"])))
    if "log_radiance" in arrays:
        light.log_radiance = mi.TensorXf(arrays["log_radiance"])
    return light
