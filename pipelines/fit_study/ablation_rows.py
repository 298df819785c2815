"""The rows of the ablation: each changes the settings of one idea."""

from __future__ import annotations

import dataclasses
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
        return dataclasses.replace(base, **self.changes)


#: Accepts whatever was tried.
_ALWAYS = 1e9


def _group(title: str, *rows: tuple[str, str, dict]) -> list[Row]:
    return [Row(title, name, says, changes) for name, says, changes in rows]


ROWS = [
    *_group("Default",
            ("default", "everything on", {}),
            ("seed-1", "another seed", {"seed": 1}),
            ("seed-2", "a third seed", {"seed": 2})),
    *_group("Visual hull",
            ("hull-plain", "daylight that two views see carves", {"hull_daylight_votes": 0.0}),
            ("hull-filled", "no enclosed daylight carves", {"hull_daylight_votes": 1.0})),
    *_group("Openings by the radiance ghost",
            ("no-openings", "none accepted", {"ghost_gain": 0.0}),
            ("no-opening-test", "all accepted, no test", {"ghost_gain": _ALWAYS}),
            ("no-ghost-smoothing", "no Sobolev gradient", {"ghost_smoothing": 0.0}),
            ("no-ghost-closing", "no closing pressure", {"ghost_closing": 0.0}),
            ("no-ghost-binary", "opacity need not decide", {"ghost_binary": 0.0}),
            ("no-ghost-chroma", "no tie of the two sides", {"ghost_chroma": 0.0}),
            ("no-ghost-daylight", "no daylight term", {"ghost_daylight": 0.0}),
            ("no-ghost-mask", "no mask loss", {"ghost_mask": 0.0})),
    *_group("Carving",
            ("no-carving", "the hull as it is", {"carving_iterations": 0})),
    *_group("Photometric refinement",
            ("no-refinement", "off", {"refinement_iterations": 0}),
            ("no-folds", "first round only", {"folds_iterations": 0}),
            ("folds-always", "second round kept unseen", {"folds_descent": _ALWAYS, "folds_gain": _ALWAYS}),
            ("no-sheets", "both sides of every sheet stay", {"sheet_thickness": 0.0}),
            ("unseen-stays", "what no view sees stays", {"unseen_area": 1.0}),
            ("refinement-always", "kept unseen", {"refinement_gain": _ALWAYS}),
            ("no-refinement-outline", "silhouettes not held", {"refinement_outline": 0.0})),
    *_group("Radiance volume",
            ("no-volume", "off", {"volume_iterations": 0}),
            ("volume-coarse", "half as many voxels per side", {"volume_side": 128}),
            ("no-volume-direction", "radiance has no direction", {"volume_direction_lr": 0.0}),
            ("no-volume-mask", "no mask loss", {"volume_mask": 0.0}),
            ("no-volume-distortion", "rays may see a spread", {"volume_distortion": 0.0})),
    *_group("Geometry in the joint stage",
            ("no-joint", "no joint stage", {"iterations": 0}),
            ("fixed-geometry", "only material and light",
             {"geometry_lr": 0.0, "msdf_lr": 0.0, "deform_lr": 0.0}),
            ("no-sobolev", "no Sobolev gradient", {"geometry_smoothing": 0.0}),
            ("fine-only", "smoothing 1 throughout", {"geometry_smoothing": 1.0}),
            ("coarse-only", "smoothing 8 throughout", {"geometry_smoothing": 8.0, "geometry_detail": 8.0}),
            ("no-offsets", "no vertex offsets", {"deform_lr": 0.0}),
            ("no-second-look", "no second look at openings", {"second_look": 1.0}),
            ("one-view", "one view per step", {"step_views": 1}),
            ("no-warmup", "no warm-up", {"warmup": 0.0}),
            ("shadow-derivatives", "visibility of shadows differentiated", {"reparam_depth": 2}),
            ("short-paths", "images lack what is not differentiated", {"max_depth": 3}),
            ("direct-light", "direct light only", {"max_depth": 2})),
    *_group("Material and light in the joint stage",
            ("painted-start", "colours start as the images show them", {"even_start": False}),
            ("no-hold", "colours move as early as the light", {"color_hold": 0.0}),
            ("painted-no-hold", "both", {"even_start": False, "color_hold": 0.0}),
            ("light-0.2", "shorter steps of the light", {"light_lr": 0.2}),
            ("light-1", "longer steps of the light", {"light_lr": 1.0})),
    *_group("Lattice, docs/grids.md",
            ("grid-cube", "cubes", {"grid": "cube"}),
            ("grid-flexicubes", "FlexiCubes", {"grid": "flexicubes"}),
            ("grid-bcc", "body-centred cubic", {"grid": "bcc"})),
    *_group("What is optimised, docs/grids.md",
            ("field-multiresolution", "sums of grids", {"field": "multiresolution"}),
            ("field-hashgrid", "hash grid and network", {"field": "hashgrid"}),
            ("field-sinusoidal", "sinusoidal network", {"field": "sinusoidal"})),
    *_group("Losses left out",
            ("no-mask", "mask", {"joint_mask": 0.0}),
            ("no-material-smoothness", "material smoothness", {"material_smoothness": 0.0}),
            ("no-material-sobolev", "Sobolev gradient of the material", {"material_gradient_smoothing": 0.0}),
            ("no-grey-world", "grey-world prior", {"light_grey": 0.0})),
    *_group("Opening and closing weights",
            ("opening-0.0005", "opening 0.0005", {"hole_opening": 0.0005}),
            ("opening-0.005", "opening 0.005", {"hole_opening": 0.005}),
            ("closing-0.1", "closing 0.1", {"hole_closing": 0.1}),
            ("closing-1", "closing 1", {"hole_closing": 1.0}),
            ("opening-closing", "opening 0.0005, closing 1", {"hole_opening": 0.0005, "hole_closing": 1.0}),
            ("visible-outside", "visible ν pushed down outside masks, 0.03", {"visible_outside": 0.03}),
            ("visible-inside", "visible ν pushed up inside masks, 1", {"visible_inside": 1.0})),
    *_group("Losses put in",
            ("sdf-sign", "sign cross-entropy 0.002", {"sdf_sign": 0.002}),
            ("eikonal", "eikonal 0.002", {"eikonal": 0.002}),
            ("template-smoothness", "template smoothness 0.02", {"template_smoothness": 0.02}),
            ("albedo-chroma", "albedo chroma 0.1", {"albedo_chroma": 0.1}),
            ("light-smoothness", "light smoothness 0.02", {"light_smoothness": 0.02})),
    *_group("Image loss",
            ("image-smape", "SMAPE", {"image_loss": "smape"}),
            ("image-relative-l2", "relative L2", {"image_loss": "relative_l2"}),
            ("image-l1", "L1", {"image_loss": "l1"})),
]
