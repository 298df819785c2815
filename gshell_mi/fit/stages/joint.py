"""Joint and detail stage: geometry, material and light by differentiable path tracing.

The joint stage works on a lattice of few cells, as a step moves a surface by a fraction of a cell; the detail
stage goes on from there on the lattice that the fit ends on. Both move the rims of openings; which openings
there are is asked again between them (``revision``), and where they end after both (``rims``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import mitsuba as mi
import numpy as np

from ...bounds import Between
from ...fields import LatticeFields
from ...fields.interpolation import Interpolation
from ...lattice import BlockLattice, Lattice, lattice_of, make_lattice
from ...light import EnvironmentLight
from ...material import GivenMaterial, MaterialField, given_material
from ...scene import FitScene
from ...template.msdf_transfer import transfer_msdf
from ..joint.joint import JointStage
from ..runner import Steps
from ..sheets import with_open_sheets
from ..stage import Fit
from ..surface import TYPICAL_REFLECTANCE, Surface, under
from ..unseen import without_unseen_parts

if TYPE_CHECKING:
    from ..config import FitConfig

#: Share of the surrounding vertices that have a radiance, from which a point between them has one.
_KNOWN = 0.1

#: Names of what is kept of fields in blocks of a stage that goes on.
_BLOCKS = "blocks "


@dataclass(frozen=True)
class JointConfig:
    """Joint stage: how far geometry, material and light move in a step."""

    warmup: Annotated[float, Between(0, 1)] = 0.15
    """Fraction of the steps in which only material and light move."""
    geometry_lr: float = 0.25
    """Largest change of sdf per step, in cells."""
    msdf_lr: float = 0.4
    """Largest change of the mSDF per step, in cells; falls a hundredfold. Its steps are halfway between one
    size per vertex and one for all, so that a rim moves where it hardly shows, too."""
    deform_lr: float = 0.035
    """Largest change of the vertex offsets per step; 1 is the greatest offset allowed."""
    geometry_smoothing: float = 100.0
    """Lambda of the Sobolev gradient (I + lambda L)^-1 on the lattice when the geometry starts to move: whole
    parts move first, details last. Few iterations solve for it, so all above 16 spread over two cells."""
    geometry_detail: float = 1.0
    """Lambda at the end; falls geometrically. Nothing is smoothed if either is 0."""
    material_smoothing: float = 1.0
    """Lambda of the material's Sobolev gradient on the lattice; spreads colour to what few pixels see."""
    material_lr: float = 0.2
    """Adam's step for base colour, roughness and metallic (logits)."""
    color_hold: Annotated[float, Between(0, 1)] = 0.5
    """Fraction of the stage in which the base colour's steps grow from 0 to the material's if the light is
    sought: shading that colours take up first, the light never gets back."""
    light_lr: float = 0.75
    """Adam's step for the environment map (logarithm of its radiance) at the texel that is told most."""


@dataclass(frozen=True)
class DetailConfig(JointConfig):
    """Detail stage: the surface is nearly where it belongs, and the lattice is finer."""

    iterations: int = 60
    """Steps of the detail stage, which continues the joint stage on a lattice finer than
    --lattice.start-resolution; 0 runs the joint stage itself on that lattice, and leaves out poses, revision,
    alignment and rims."""
    warmup: Annotated[float, Between(0, 1)] = 0.0
    geometry_lr: float = 0.125
    geometry_smoothing: float = 4.0
    material_lr: float = 0.06
    color_hold: Annotated[float, Between(0, 1)] = 0.0
    light_lr: float = 0.225


class Joint:
    """Moves everything at once.

    Args:
        name: of the stage.
        config: its settings.
        iterations: its steps.
        before: steps of the stages before it that move everything, too.
        lattice: to work on, unless the surface is on a finer one; None for the one that the fit ends on, with
            nothing to do if the surface is on that already, and settled.
    """

    def __init__(
        self,
        name: str,
        config: JointConfig,
        iterations: int,
        lattice: Lattice | None = None,
        *,
        before: int = 0,
    ):
        self.name, self.config, self.iterations, self.lattice = name, config, iterations, lattice
        self.before = before

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with material and light."""
        lattice, resolution = self.lattice or fit.lattices.end_of(surface), surface.lattice.resolution
        if resolution >= lattice.resolution:
            if not self.lattice and surface.settled:
                return surface
            lattice = make_lattice(lattice.grid, resolution)
        subject, config = fit.scene.subject, fit.config
        fields = start_fields(subject, surface, lattice, config.lattice.band_resolution, steps.kept)
        subject.set_fields(fields)
        joint = JointStage(
            fit.scene,
            start_material(fit.scene, surface, fields.lattice, config),
            start_light(fit.scene, surface, config),
            config,
            stage=self.config,
            name=self.name,
            iterations=self.iterations,
            before=self.before,
            turns=fit.views.turns,
        )
        if joint.geometry.fitting_steps and not steps.done:
            with steps.task("start", joint.geometry.fitting_steps) as advance:
                for iteration in range(joint.geometry.fitting_steps):
                    joint.geometry.fit_step(iteration)
                    advance()
                joint.geometry.begin()
        steps.run(
            joint,
            self.iterations,
            joint.optimizers,
            lambda: _prefixed(_BLOCKS, block_arrays(subject.fields())),
        )
        joint.finish()
        result = replace(
            surface, fields=joint.moved_fields(), hull=None, moved=(), model=joint.model(), settled=True
        )
        return with_open_sheets(fit, without_unseen_parts(fit, result))


def start_fields(
    subject: mi.Shape,
    surface: Surface,
    lattice: Lattice,
    band_resolution: int,
    kept: Mapping[str, np.ndarray],
) -> LatticeFields:
    """The fields of a surface on a lattice; in blocks if it is that fine.

    Args:
        subject: the gshell shape, in whose place they are.
        surface: on any lattice.
        lattice: as of the result.
        band_resolution: cells per side from which on blocks are stored.
        kept: where a stage goes on, its ``block_arrays`` are the fields.
    """
    if stored := under(kept, _BLOCKS):
        return LatticeFields(**stored, grid=lattice.grid, block_resolution=lattice.resolution)
    fields = surface.on_grid(lattice.grid).fields
    if fields.blocks is not None and fields.lattice.resolution == lattice.resolution:
        return fields
    in_blocks = lattice.resolution >= band_resolution and lattice.fits_in_blocks
    fields = fields.whole()
    if fields.lattice == lattice:
        return fields.in_blocks() if in_blocks else fields
    resample = fields.in_blocks if in_blocks else fields.to_lattice
    return transfer_msdf(subject, fields, resample(lattice.resolution))


def block_arrays(fields: LatticeFields) -> dict[str, np.ndarray]:
    """What ``start_fields`` needs of fields in blocks; nothing of others."""
    if fields.blocks is None:
        return {}
    return {name: getattr(fields, name) for name in ("sdf", "msdf", "deform", "blocks")}


def start_material(
    scene: FitScene, surface: Surface, lattice: Lattice | BlockLattice, config: FitConfig
) -> MaterialField | GivenMaterial:
    """The scene's own material or, as a field on a lattice, what a joint stage has left of it, or what is
    known of it and the colours that were seen."""
    given = given_material(scene.bsdf)
    if config.material_is_given:
        return GivenMaterial(lattice.vertex_count, **given)
    if "vertex_color" in surface.model:
        return _resampled_material(surface, lattice)
    radiance, known = surface.sight.radiance, surface.sight.known
    seen_on = lattice_of(lattice.grid, len(known))
    if seen_on != lattice:
        points = lattice.points(mi.Float)
        share = Interpolation(mi.Float(known.astype(np.float32)), seen_on)(points).numpy()
        # Where nothing is known the radiance is 0.
        total = Interpolation(mi.Float(radiance.astype(np.float32).ravel()), seen_on)(points).numpy()
        known = share > _KNOWN
        radiance = total.reshape(-1, 3) / np.maximum(share, _KNOWN)[:, None]
    seen = radiance / surface.sight.light
    if config.model.even_start and not config.light_is_given and known.any():
        seen = np.broadcast_to(np.median(seen[known], axis=0), seen.shape)
    reflectance = np.where(known[:, None], seen, TYPICAL_REFLECTANCE)
    return MaterialField(reflectance, **given)


def _resampled_material(surface: Surface, lattice: Lattice | BlockLattice) -> MaterialField:
    """The material that a joint stage has left, on another lattice."""
    points = lattice.points(mi.Float)
    material = MaterialField(np.full((lattice.vertex_count, 3), TYPICAL_REFLECTANCE))
    material.parameters = {name: mi.Float(surface.model[name]) for name in material.parameters}
    before = surface.on_grid(lattice.grid).lattice
    for name in material.on_lattice:
        given = material.parameters[name]
        if isinstance(before, BlockLattice):
            whole = before.spread_out(given), before.lattice
        else:
            whole = given, before
        # Blocks of the same lattice may be others: they have followed the surface before a fit was stopped.
        material.parameters[name] = Interpolation(*whole)(points)
    return material


def start_light(scene: FitScene, surface: Surface, config: FitConfig) -> EnvironmentLight | None:
    """The map to optimise: what a joint stage has left, the scene's, or an even one as bright as the object;
    None keeps the scene's."""
    if config.light_is_given:
        return None
    height = config.model.light_height
    light = EnvironmentLight.from_emitter(scene.light, height) or EnvironmentLight.uniform(
        height, float(surface.sight.light)
    )
    if "log_radiance" in surface.model:
        light.log_radiance = mi.TensorXf(surface.model["log_radiance"])
    return light


def _prefixed(prefix: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {prefix + name: array for name, array in arrays.items()}
