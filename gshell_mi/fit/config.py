"""Everything that steers a fit, in one frozen dataclass that is also the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from ..errors import UserError

#: Least sensible value of a number, where that is not 0.
_LEAST = {"resolution": 4, "start_resolution": 4, "band_resolution": 4, "triptychs": 1, "ghost_iterations": 1,
          "ghost_batch": 1, "ghost_sheets": 1, "carving_batch": 1, "step_views": 1, "spp": 1, "primal_spp": 1,
          "max_depth": 2, "gradient_depth": 2, "reparam_depth": 1, "light_height": 3}

#: Greatest sensible value, where there is one.
_MOST = {"seed": 2**32 - 1, "hull_daylight_votes": 1, "ghost_min_area": 1, "unseen_area": 1, "warmup": 1,
         "color_hold": 1, "second_look": 1, "reparam_depth": 3}

#: What the detail stage takes of the first steps of the joint stage for material and light.
_CALMER = 0.3

#: What ``--preview`` has instead: less of everything, but for the steps that openings need.
_PREVIEW = {"resolution": 48, "ghost_iterations": 600, "ghost_batch": 16384, "ghost_rounds": 0,
            "carving_iterations": 0, "refinement_iterations": 0,
            "volume_iterations": 0, "iterations": 70, "step_views": 1,
            "primal_spp": 4, "max_depth": 2, "color_hold": 0, "even_start": False, "light_height": 16,
            "second_look": 1, "triptychs": 4}


@dataclass(frozen=True)
class FitConfig:
    """Settings of a fit; the defaults are meant for every object.

    Lengths marked *cells* are in cells of the lattice.
    """

    seed: int = 0
    """Seed of every random number of the fit."""
    resolution: int | None = None
    """Cells per side of the lattice; default: that of the scene's gshell shape (64)."""
    grid: Literal["tet", "cube", "flexicubes", "bcc"] | None = None
    """The kind of lattice; default: that which the scene's gshell shape names, or flexicubes."""
    start_resolution: int = 64
    """Cells per side, at most, up to the detail stage. Unused if the scene gives the fields."""
    band_resolution: int = 128
    """From this resolution on the joint stage stores its fields in blocks around the surface."""
    checkpoint_seconds: float = 10.0
    """Seconds between checkpoints: what a kill loses at most."""
    triptychs: int = 16
    """Training views, spread evenly, that are rendered at the end: for views/ and for psnr_training."""

    # --- modes: what is known already
    known_light: bool = False
    """Keep the scene's light as it is instead of optimising it."""
    fixed_material: bool = False
    """Keep the uniform principled material that the scene gives the gshell shape."""
    geometry_only: bool = False
    """Optimise nothing but the geometry, and from the images alone: light and material are those of the
    scene, the mask loss of the joint stage is off, and shading normals are those of the faces."""
    watertight: bool = False
    """The object is closed: the mSDF stays positive and no openings are looked for."""

    # --- visual hull
    hull_daylight_votes: float = 0.15
    """Fraction of the views that must see daylight at a point before an enclosed hole of the masks is
    carved."""

    # --- radiance ghost: finds the openings
    ghost_iterations: int = 400
    """Steps of the radiance ghost."""
    ghost_batch: int = 65536
    """Pixels per step over all views, of which those far from the masks are left out."""
    ghost_sheets: int = 4
    """Sheets of the template that a ray composites."""
    ghost_lr: float = 0.1
    """Adam's step for opacity logits and radiance; falls tenfold over the stage."""
    ghost_smoothing: float = 2.0
    """Lambda of the Sobolev gradient (I + lambda L)^-1 on the template."""
    ghost_mask: float = 0.003
    """Weight of the mask loss. The image loss also sees the mask; a large weight closes every cap before
    the images can open it."""
    ghost_daylight: float = 0.1
    """Weight of coverage where a mask shows daylight through the template: proof of openings, unlike the rest
    of the mask."""
    ghost_binary: float = 0.01
    """Final weight of the loss that makes opacity decide; ramps up over the second half."""
    ghost_closing: float = 0.0005
    """Final weight of the loss that closes what the images leave undecided."""
    ghost_chroma: float = 0.003
    """Weight of the tie between the chroma of a sheet's two sides."""
    ghost_gain: float = 0.93
    """An opening stays if the image error through it is below this fraction of what it is when closed."""
    ghost_rounds: int = 3
    """How often, at most, the ghost is trained again for what wrong openings have hidden."""
    ghost_min_area: float = 0.005
    """Holes smaller than this fraction of the template's area are noise and are undone, and islands smaller
    than this fraction of the surface's."""

    # --- carving: folds and hollows that the hull bridges
    vessel_gain: float = 0.75
    """Openings lead into the hollow of something solid, such as a mug, if a wall behind them brings the image
    error through them below this fraction."""
    carving_iterations: int = 1000
    """Steps of the radiance volume; 0 leaves the hull as it is."""
    carving_batch: int = 65536
    """Pixels per step over all views, of which those far from the masks are left out."""
    carving_lr: float = 0.6
    """Adam's step for the density's logits; halves over the coarse steps, then falls tenfold."""
    carving_radiance_lr: float = 0.05
    """Adam's step for the radiance, as a fraction of the targets' mean."""

    # --- photometric refinement: moves the surface inside the hull
    refinement_iterations: int = 400
    """Steps of the photometric refinement; 0 keeps the hull's shape."""
    refinement_lr: float = 0.12
    """Largest movement of a vertex per step, in cells; falls to 0 like a cosine."""
    refinement_smoothing: float = 95.0
    """Lambda of the Sobolev gradient on the template when it starts to move, in square cells: whole parts
    move first."""
    refinement_detail: float = 34.0
    """Lambda at the end; falls geometrically. Nothing is smoothed if either is 0."""
    refinement_radiance_lr: float = 0.05
    """Adam's step for the radiance meanwhile."""
    refinement_outline: float = 0.001
    """Weight of the squared distance, in cells, between silhouettes and masks; falls to half."""

    refinement_gain: float = 0.9
    """The refinement is kept if it brings the image error of views that it did not see below this fraction.
    Where radiance depends much on the view (gloss), it may explain the views it sees by a wrong shape."""

    folds_iterations: int = 440
    """Steps of a second round of the refinement, which moves details farther; 0 leaves it out."""
    folds_lr: float = 0.3
    """Largest movement of a vertex per step of the second round, in cells; falls to 0 like a cosine."""
    folds_detail: float = 11.0
    """Lambda at the end of the second round, which starts with that of the first's end."""
    folds_descent: float = 0.98
    """The second round ends after a quarter of its steps unless the image error is below this fraction of
    what it was at first: such rounds are not kept in the end."""
    folds_gain: float = 0.97
    """The second round is kept if it brings the image error of unseen views below this fraction: it hollows
    out pleats, but smooth surfaces without texture drift."""

    # --- radiance volume: another start, for what no hull shows
    volume_iterations: int = 700
    """Steps of the radiance volume whose surface the joint stage starts from if it explains unseen views
    better; 0 leaves it out."""
    volume_side: int = 256
    """Voxels per side of its last level."""
    volume_resolution: int = 128
    """Cells per side of the lattice, at least, if the fit starts from it and --resolution does not say."""
    volume_batch: int = 131072
    """Rays per step over all pixels, of which those far from the masks are left out."""
    volume_density_lr: float = 0.3
    """Adam's step for the logits of the densities; falls tenfold over the last level."""
    volume_radiance_lr: float = 0.03
    """Adam's step for the radiance, as a fraction of the targets' mean."""
    volume_direction_lr: float = 0.03
    """The same for what depends on the direction."""
    volume_mask: float = 1.0
    """Weight of the coverage's squared error beside that of the radiance."""
    volume_distortion: float = 0.01
    """Weight of how far apart along a ray is what it sees, in lengths of the lattice's cube."""

    sheet_thickness: float = 0.5
    """Closed parts that are at most so thick, in cells, come out as a single open sheet; 0 keeps both sides
    of every sheet, beside openings too."""
    unseen_area: float = 0.02
    """What no view sees, from neither side, is opened if it is connected and larger than this fraction of
    the template's area; 1 keeps it."""

    # --- joint stage: geometry, material and light by path tracing
    field: Literal["explicit", "multiresolution", "hashgrid", "sinusoidal"] = "explicit"
    """What the geometry is optimised as: the lattice's values themselves, sums of grids of several
    resolutions, a hash grid with a small network, or a sinusoidal network."""
    flexicubes_weights: bool = False
    """Also optimise the 21 weights per cube of FlexiCubes, which makes a step slower by a tenth; the hat is
    none the better for it."""
    iterations: int = 210
    """Steps of the joint stage."""
    step_views: int = 3
    """Views that a step of the joint stage renders; it follows the mean of their losses. What a step takes
    beside rendering is shared by them."""
    warmup: float = 0.15
    """Fraction of these steps in which only material and light move."""
    detail_iterations: int = 60
    """Steps of the detail stage, which continues the joint stage on a lattice finer than --start-resolution;
    0 runs the joint stage itself on that lattice."""
    spp: int = 2
    """Samples per pixel of the gradient render."""
    primal_spp: int = 6
    """Samples per pixel of the image that the loss compares; independent of the gradient's samples."""
    max_depth: int = 5
    """Longest path: 2 is direct light, 3 adds one interreflection. That of the exported scene is 5."""
    gradient_depth: int = 3
    """Longest path that is differentiated; what longer ones add to an image counts as constant."""
    reparam_depth: int = 1
    """Path segments whose visibility is differentiated: 1 is what the camera sees, 2 adds shadows. Shapes
    come out the same with either, a dress with deep folds 0.2 dB better with 2, and 1 is faster."""
    second_look: float = 0.5
    """Fraction of the steps after which openings grow where what is behind the surface beside them explains
    the images about as well, and small ones are shut that explain them badly; 1 leaves it out. Only if
    --field is explicit."""
    second_look_gain: float = 3.0
    """Such a change stays if, after half of the remaining steps, the squared image error there is below this
    multiple of what it was, times what the rest of the surface has gained meanwhile. Above 1, as colours were
    fitted to a cap for longer than anything was to what is behind it."""
    geometry_lr: float = 0.25
    """Largest change of sdf per step, in cells; of the mSDF too if --field is not explicit."""
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
    material_gradient_smoothing: float = 1.0
    """Lambda of the material's Sobolev gradient on the lattice; spreads colour to what few pixels see."""
    color_voxels: int = 0
    """Voxels per cell of the last lattice that the base colour has around the surface, which makes it as fine
    as the images; 0 leaves it to the lattice's vertices."""
    material_lr: float = 0.2
    """Adam's step for base colour, roughness and metallic (logits)."""
    color_hold: float = 0.5
    """Fraction of the stage in which the base colour's steps grow from 0 to --material-lr if the light is
    sought: shading that colours take up first, the light never gets back."""
    even_start: bool = True
    """Start from one base colour, the median of those that the ghost saw, if the light is sought; otherwise
    from what it saw, shading and all."""
    light_lr: float = 0.75
    """Adam's step for the environment map (logarithm of its radiance) at the texel that is told most."""
    light_height: int = 32
    """Rows of the optimised environment map; it has twice as many columns."""
    # --- losses of the joint stage: docs/losses.md has their formulas. Weight 0 leaves one out.
    image_loss: Literal["log_l1", "smape", "relative_l2", "l1"] = "log_l1"
    """What compares a render with its target."""
    joint_mask: float = 4.0
    """Weight of the mask loss."""
    joint_depth: float = 0.01
    """Weight of the depth loss, in cells; only used with depth maps."""
    hole_opening: float = 0.0
    """Weight of what pulls the mSDF of the surface below 0, so that openings appear and can be judged."""
    hole_closing: float = 0.0
    """Weight of what pulls the mSDF of visible boundaries above 0, so that holes shut."""
    visible_outside: float = 0.0
    """Weight of the mSDF that is seen outside the masks."""
    visible_inside: float = 0.0
    """Weight of negative mSDF where a mask is covered and no surface is."""
    sdf_sign: float = 0.0
    """Weight of the cross-entropy between the signs of neighbouring lattice vertices: removes floaters."""
    eikonal: float = 0.0
    """Weight of the squared difference between the slope of the signed distance and 1, near the surface."""
    template_smoothness: float = 0.0
    """Weight of the squared difference of the template's normals along its edges."""
    material_smoothness: float = 0.01
    """Weight of the difference between the material at a point and at a point nearby."""
    albedo_chroma: float = 0.0
    """Weight of the difference between the chroma of the base colour and of the image that shows it."""
    light_smoothness: float = 0.0
    """Weight of the difference between neighbouring texels of the light's logarithm."""
    light_grey: float = 0.005
    """Weight of the grey-world prior of the light."""
    flexicubes_deviation: float = 0.01
    """Weight of the FlexiCubes regulariser, in cells; only used with that grid."""

    @classmethod
    def preview(cls, **others) -> FitConfig:
        """The settings of ``--preview``, a rough result in half a minute; ``others`` replace some of them.

        >>> FitConfig.preview(iterations=3).iterations, FitConfig.preview().refinement_iterations
        (3, 0)
        """
        return cls(**_PREVIEW | others)

    def for_folds(self) -> FitConfig:
        """The settings of the refinement as those of its second round."""
        return replace(self, refinement_iterations=self.folds_iterations, refinement_lr=self.folds_lr,
                       refinement_smoothing=self.refinement_detail, refinement_detail=self.folds_detail)

    def for_detail(self) -> FitConfig:
        """The settings of the joint stage as those of the detail stage, which begins where that has ended."""
        # The lattice is twice as fine: the same smoothing is four times as many square cells. The surface is
        # nearly where it belongs.
        return replace(self, iterations=self.detail_iterations, warmup=0, color_hold=0, second_look=1,
                       geometry_lr=0.5 * self.geometry_lr, geometry_smoothing=4 * self.geometry_detail,
                       material_lr=_CALMER * self.material_lr, light_lr=_CALMER * self.light_lr)

    @property
    def light_is_given(self) -> bool:
        return self.known_light or self.geometry_only

    @property
    def material_is_given(self) -> bool:
        return self.fixed_material or self.geometry_only

    def __post_init__(self):
        for name, value in vars(self).items():
            if isinstance(value, str | bool | None):
                continue
            flag, least, most = f"--{name.replace('_', '-')}", _LEAST.get(name, 0), _MOST.get(name)
            if not math.isfinite(value):
                raise UserError(f"{flag} must be a finite number, not {value}.")
            if value < least:
                raise UserError(f"{flag} must be at least {least}, not {value}.")
            if most is not None and value > most:
                raise UserError(f"{flag} must be at most {most}, not {value}.")


def default_output(scene: Path) -> Path:
    """``out/NAME`` for ``.../NAME.xml``."""
    return Path("out") / scene.stem
