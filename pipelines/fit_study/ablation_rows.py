"""The rows of the ablation: each switches off one stage, or changes the settings of one idea."""

from __future__ import annotations

from dataclasses import dataclass

from gshell_mi.fit import FitConfig


@dataclass(frozen=True)
class Row:
    """One row: how it is called in files, what it says in the table, and the settings that it changes."""

    group: str
    name: str
    says: str
    changes: dict

    def config(self, base: FitConfig) -> FitConfig:
        """The settings of the row, on top of those that all rows share."""
        return base.changed(self.changes)


#: Accepts whatever was tried.
_ALWAYS = 1e9


def _group(title: str, *rows: tuple[str, str, dict]) -> list[Row]:
    return [Row(title, name, says, changes) for name, says, changes in rows]


#: The stages of a fit in their order, each without the others being changed.
STAGES = _group(
    "Without one of the stages",
    ("default", "all stages", {}),
    ("no-openings", "*openings*, *revision*, *rims*: where the hull is open in truth", {"watertight": True}),
    ("no-cavities", "*cavities*: folds and hollows that the hull bridges", {"cavities.iterations": 0}),
    (
        "no-refinement",
        "*refinement*, and *folds*: whole parts move to where the images agree",
        {"refinement.iterations": 0},
    ),
    ("no-folds", "*folds*, and *fine_folds*: the same for details", {"folds.iterations": 0}),
    (
        "no-volume",
        "*volume*: another start, for gaps and struts that no hull shows",
        {"volume.iterations": 0},
    ),
    (
        "no-joint",
        "*joint*, and what follows: shape, material and light by light transport",
        {"iterations": 0},
    ),
    ("no-poses", "*poses*: cameras corrected", {"poses": "keep"}),
    (
        "no-revision",
        "*revision*, and *rims*: openings judged again where the surface has moved",
        {"openings.revise": False},
    ),
    (
        "no-detail",
        "*poses*, *revision*, *detail*, *rims*: all between *joint* and *smoothing*",
        {"detail.iterations": 0},
    ),
    ("no-smoothing", "*smoothing*: bumps that are noise", {"smoothing.most": 0.0}),
    ("no-texture", "*texture*: colours as fine as the images", {"texture.rounds": 0}),
)

#: What single choices within the stages are worth, and losses.
CHOICES = [
    *_group(
        "Other random numbers",
        ("seed-1", "another seed", {"seed": 1}),
        ("seed-2", "a third seed", {"seed": 2}),
    ),
    *_group(
        "Visual hull",
        ("hull-plain", "daylight that two views see carves", {"hull.daylight_votes": 0.0}),
        ("hull-filled", "no enclosed daylight carves", {"hull.daylight_votes": 1.0}),
    ),
    *_group(
        "Openings",
        ("no-openings-smoothing", "no Sobolev gradient", {"radiance.smoothing": 0.0}),
        ("no-openings-closing", "no closing pressure", {"openings.closing": 0.0}),
        ("no-openings-binary", "opacity need not decide", {"openings.binary": 0.0}),
        ("no-openings-chroma", "no tie of the two sides", {"openings.chroma": 0.0}),
        ("no-openings-daylight", "no daylight term", {"openings.daylight": 0.0}),
        ("no-openings-mask", "no mask loss", {"openings.mask": 0.0}),
    ),
    *_group(
        "Photometric refinement",
        ("folds-to-the-end", "second round never ends early", {"folds.descent": _ALWAYS}),
        ("no-sheets", "both sides of every sheet stay", {"topology.sheet_thickness": 0.0}),
        ("unseen-stays", "what no view sees stays", {"topology.unseen_area": 1.0}),
        ("no-refinement-outline", "silhouettes not held", {"refinement.outline": 0.0, "folds.outline": 0.0}),
    ),
    *_group(
        "Radiance volume",
        ("volume-coarse", "half as many voxels per side", {"volume.side": 128}),
        ("no-volume-direction", "radiance has no direction", {"volume.direction_lr": 0.0}),
        ("no-volume-mask", "no mask loss", {"volume.mask": 0.0, "cavities.mask": 0.0}),
        (
            "no-volume-distortion",
            "rays may see a spread",
            {"volume.distortion": 0.0, "cavities.distortion": 0.0},
        ),
    ),
    *_group(
        "Geometry in the joint stage",
        (
            "fixed-geometry",
            "only material and light",
            {"joint.geometry_lr": 0.0, "joint.msdf_lr": 0.0, "joint.deform_lr": 0.0},
        ),
        ("no-sobolev", "no Sobolev gradient", {"joint.geometry_smoothing": 0.0}),
        ("fine-only", "smoothing 1 throughout", {"joint.geometry_smoothing": 1.0}),
        (
            "coarse-only",
            "smoothing 8 throughout",
            {"joint.geometry_smoothing": 8.0, "joint.geometry_detail": 8.0},
        ),
        ("no-offsets", "no vertex offsets", {"joint.deform_lr": 0.0}),
        ("one-view", "one view per step", {"render.views": 1}),
        ("no-warmup", "no warm-up", {"joint.warmup": 0.0}),
        ("shadow-derivatives", "visibility of shadows differentiated", {"render.reparam_depth": 2}),
        ("short-paths", "images lack what is not differentiated", {"render.max_depth": 3}),
        ("direct-light", "direct light only", {"render.max_depth": 2}),
    ),
    *_group(
        "Material and light in the joint stage",
        ("painted-start", "colours start as the images show them", {"model.even_start": False}),
        ("no-hold", "colours move as early as the light", {"joint.color_hold": 0.0}),
        ("painted-no-hold", "both", {"model.even_start": False, "joint.color_hold": 0.0}),
        ("light-0.2", "shorter steps of the light", {"joint.light_lr": 0.2}),
        ("light-1", "longer steps of the light", {"joint.light_lr": 1.0}),
    ),
    *_group(
        "Lattice, docs/grids.md",
        ("grid-cube", "cubes", {"grid": "cube"}),
        ("grid-flexicubes", "FlexiCubes", {"grid": "flexicubes"}),
        ("grid-bcc", "body-centred cubic", {"grid": "bcc"}),
    ),
    *_group(
        "What is optimised, docs/grids.md",
        ("field-multiresolution", "sums of grids", {"model.field": "multiresolution"}),
        ("field-hashgrid", "hash grid and network", {"model.field": "hashgrid"}),
        ("field-sinusoidal", "sinusoidal network", {"model.field": "sinusoidal"}),
    ),
    *_group(
        "Losses left out",
        ("no-mask", "mask", {"losses.mask": 0.0}),
        ("no-material-smoothness", "material smoothness", {"losses.material_smoothness": 0.0}),
        ("no-material-sobolev", "Sobolev gradient of the material", {"joint.material_smoothing": 0.0}),
        ("no-grey-world", "grey-world prior", {"losses.light_grey": 0.0}),
    ),
    *_group(
        "Opening and closing weights",
        ("opening-0.0005", "opening 0.0005", {"losses.extra": {"hole_opening": 0.0005}}),
        ("opening-0.005", "opening 0.005", {"losses.extra": {"hole_opening": 0.005}}),
        ("closing-0.1", "closing 0.1", {"losses.extra": {"hole_closing": 0.1}}),
        ("closing-1", "closing 1", {"losses.extra": {"hole_closing": 1.0}}),
        (
            "opening-closing",
            "opening 0.0005, closing 1",
            {"losses.extra": {"hole_opening": 0.0005, "hole_closing": 1.0}},
        ),
        (
            "visible-outside",
            "visible ν pushed down outside masks, 0.03",
            {"losses.extra": {"visible_outside": 0.03}},
        ),
        ("visible-inside", "visible ν pushed up inside masks, 1", {"losses.extra": {"visible_inside": 1.0}}),
    ),
    *_group(
        "Losses put in",
        ("sdf-sign", "sign cross-entropy 0.002", {"losses.extra": {"sdf_sign": 0.002}}),
        ("eikonal", "eikonal 0.002", {"losses.extra": {"eikonal": 0.002}}),
        ("normal-variation", "variation of normals 0.1", {"losses.extra": {"normal_variation": 0.1}}),
        ("albedo-chroma", "albedo chroma 0.1", {"losses.extra": {"albedo_chroma": 0.1}}),
        ("light-smoothness", "light smoothness 0.02", {"losses.extra": {"light_smoothness": 0.02}}),
    ),
    *_group(
        "Image loss",
        ("image-smape", "SMAPE", {"losses.image": "smape"}),
        ("image-relative-l2", "relative L2", {"losses.image": "relative_l2"}),
        ("image-l1", "L1", {"losses.image": "l1"}),
    ),
]

ROWS = STAGES + CHOICES
