"""The settings of a fit: a few for people on top, those of each stage in a dataclass beside the stage."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from ..bounds import Between, check_bounds, leaves
from ..radiance.surface_radiance import RadianceConfig
from .cameras.laying import CamerasConfig
from .joint.config import LossConfig, ModelConfig, RenderConfig
from .stages.cavities import CavitiesConfig
from .stages.exposures import GainsConfig
from .stages.hull import HullConfig
from .stages.joint import DetailConfig, JointConfig
from .stages.occlusion import OcclusionConfig
from .stages.openings import OpeningsConfig
from .stages.refinement import FoldsConfig, RefinementConfig
from .stages.smoothing import SmoothingConfig
from .stages.texture import TextureConfig
from .stages.volume import VolumeConfig


@dataclass(frozen=True)
class LatticeConfig:
    """How fine lattices are, and how their fields are stored."""

    start_resolution: Annotated[int, Between(4)] = 64
    """Cells per side, at most, up to the detail stage, unless a radiance volume is the start. Unused if the
    scene gives the fields."""
    band_resolution: Annotated[int, Between(4)] = 128
    """From this resolution on the joint stage stores its fields in blocks around the surface."""


@dataclass(frozen=True)
class TopologyConfig:
    """What counts as an opening, a part and a sheet."""

    min_area: Annotated[float, Between(0, 1)] = 0.005
    """Holes smaller than this fraction of the template's area are noise and are undone, and islands smaller
    than this fraction of the surface's."""
    unseen_area: Annotated[float, Between(0, 1)] = 0.02
    """What no view sees, from neither side, is opened if it is connected and larger than this fraction of
    the template's area; 1 keeps it."""
    sheet_thickness: float = 0.5
    """Closed parts that are at most so thick, in cells, come out as a single open sheet; 0 keeps both sides
    of every sheet, beside openings too."""


@dataclass(frozen=True)
class FitConfig:
    """Settings of a fit; the defaults are meant for every object.

    Lengths marked *cells* are in cells of the lattice. ``for_effort`` gives other defaults.

    Raises:
        UserError: a number is out of its bounds.
    """

    seed: Annotated[int, Between(0, 2**32 - 1)] = 0
    """Seed of every random number of the fit."""
    resolution: Annotated[int | None, Between(4)] = None
    """Cells per side of the lattice; default: that of the scene's gshell shape (64)."""
    grid: Literal["tet", "cube", "flexicubes", "bcc"] | None = None
    """The kind of lattice; default: that which the scene's gshell shape names, or flexicubes."""
    iterations: int = 210
    """Steps of the joint stage."""
    known_light: bool = False
    """Keep the scene's light as it is instead of optimising it."""
    light_frame: Literal["find", "world", "camera"] = "find"
    """What the light is fixed to: the world, or the camera, as where an object turns on a turntable before
    a camera on a tripod, or where a flash is on the camera; or find which, by what views see of the same
    places. If to the camera, the exported light is as the first view has it."""
    fixed_material: bool = False
    """Keep the uniform principled material that the scene gives the gshell shape."""
    exposures: Literal["find", "keep"] = "find"
    """Whether views may differ in exposure and white balance: find the gain of each, if that explains what
    they see of the same places, or keep all images as they are."""
    poses: Literal["refine", "keep"] = "refine"
    """Whether cameras may be off by a pixel or a few: correct them where the surface that all views agree on
    says so clearly, or keep them."""
    geometry_only: bool = False
    """Optimise nothing but the geometry, and from the images alone: light and material are those of the
    scene, the mask loss of the joint stage is off, and shading normals are those of the faces."""
    watertight: bool = False
    """The object is closed: the mSDF stays positive and no openings are looked for."""
    triptychs: Annotated[int, Between(1)] = 16
    """Training views, spread evenly, that are rendered at the end: for views/ and for psnr_training."""
    hold_out: Annotated[int, Between(0)] = 0
    """Every so many-th view, from the first one on, is held out: no stage sees it, and it is scored at the
    end; 0 fits to all views. 8 is usual."""
    checkpoint_seconds: float = 10.0
    """Seconds between checkpoints while steps are done."""

    lattice: LatticeConfig = field(default_factory=LatticeConfig)
    """How fine lattices are, and how their fields are stored."""
    topology: TopologyConfig = field(default_factory=TopologyConfig)
    """What counts as an opening, a part and a sheet."""
    occlusion: OcclusionConfig = field(default_factory=OcclusionConfig)
    """Pixels whose masks deny what others see."""
    hull: HullConfig = field(default_factory=HullConfig)
    """The visual hull."""
    radiance: RadianceConfig = field(default_factory=RadianceConfig)
    """The radiance on a mesh, by which openings are sought and vertices moved."""
    openings: OpeningsConfig = field(default_factory=OpeningsConfig)
    """Where the hull is open."""
    gains: GainsConfig = field(default_factory=GainsConfig)
    """Exposure and white balance of each view."""
    cavities: CavitiesConfig = field(default_factory=CavitiesConfig)
    """Hollows that the hull bridges."""
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    """Moves the surface inside the hull."""
    folds: FoldsConfig = field(default_factory=FoldsConfig)
    """Moves details farther."""
    volume: VolumeConfig = field(default_factory=VolumeConfig)
    """Another start, for what no hull shows."""
    render: RenderConfig = field(default_factory=RenderConfig)
    """How the joint and the detail stage render."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """What the joint and the detail stage seek."""
    losses: LossConfig = field(default_factory=LossConfig)
    """What the joint and the detail stage minimise; docs/losses.md has the formulas."""
    joint: JointConfig = field(default_factory=JointConfig)
    """Geometry, material and light by path tracing."""
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    """Corrections of the poses."""
    detail: DetailConfig = field(default_factory=DetailConfig)
    """The joint stage continued on a finer lattice."""
    smoothing: SmoothingConfig = field(default_factory=SmoothingConfig)
    """Bumps that are noise."""
    texture: TextureConfig = field(default_factory=TextureConfig)
    """Colours as fine as the images."""

    @classmethod
    def for_effort(cls, effort: Effort, **changes: Any) -> FitConfig:
        """The settings of an effort; ``changes`` replace some (``joint__light_lr`` for ``joint.light_lr``).

        >>> FitConfig.for_effort("preview", iterations=3).iterations
        3
        >>> FitConfig.for_effort("preview").refinement.iterations
        0
        """
        return EFFORTS[effort].changed({name.replace("__", "."): value for name, value in changes.items()})

    def changed(self, changes: dict[str, Any]) -> FitConfig:
        """These settings with others by name.

        >>> FitConfig().changed({"seed": 3, "volume.side": 64}).volume.side
        64
        """
        nested: dict[str, dict[str, Any]] = {}
        own = {}
        for name, value in changes.items():
            stage, dot, setting = name.partition(".")
            if dot:
                nested.setdefault(stage, {})[setting] = value
            else:
                own[name] = value
        for stage, values in nested.items():
            own[stage] = dataclasses.replace(getattr(self, stage), **values)
        return dataclasses.replace(self, **own)

    def settings(self) -> dict[str, Any]:
        """Every setting by its name, such as ``joint.warmup``."""
        return {name: value for name, value, _ in leaves(self)}

    @property
    def light_is_given(self) -> bool:
        return self.known_light or self.geometry_only

    @property
    def material_is_given(self) -> bool:
        return self.fixed_material or self.geometry_only

    def __post_init__(self):
        check_bounds(self)


#: How much work a fit is.
Effort = Literal["preview", "normal", "thorough"]

#: Less of everything, but for the steps that openings need: a rough result in about a minute.
_PREVIEW = {
    "resolution": 48,
    "iterations": 70,
    "triptychs": 4,
    "radiance.batch": 16384,
    "occlusion.most": 0.0,
    "openings.iterations": 600,
    "openings.rounds": 0,
    "cavities.iterations": 0,
    "refinement.iterations": 0,
    "volume.iterations": 0,
    "render.views": 1,
    "render.primal_spp": 4,
    "render.max_depth": 2,
    "model.even_start": False,
    "model.light_height": 16,
    "smoothing.most": 0.0,
    "texture.rounds": 1,
    "joint.color_hold": 0.0,
    "openings.revise": False,
    "poses": "keep",
}

#: Twice as many steps of every stage, and twice as fine an end of what is too thin for hulls.
_THOROUGH = {
    name: 2 * value
    for name, value in FitConfig().settings().items()
    if name.split(".")[-1] == "iterations" or name == "volume.detail_resolution"
}

#: The settings of each effort.
EFFORTS: dict[Effort, FitConfig] = {
    "preview": FitConfig().changed(_PREVIEW),
    "normal": FitConfig(),
    "thorough": FitConfig().changed(_THOROUGH),
}


def default_output(scene: Path) -> Path:
    """``out/NAME`` for ``.../NAME.xml``."""
    return Path("out") / scene.stem
