"""Names that settings had before they were sorted by stage: who uses one is told the new one."""

from __future__ import annotations

from collections.abc import Iterable

from ..errors import UserError

#: What became of the flags, by the new group: old name, new name.
_MOVED = {
    "": {"preview": "effort preview"},
    "lattice": {name: name for name in ("start-resolution", "band-resolution")},
    "topology": {"ghost-min-area": "min-area"}
    | {name: name for name in ("min-area", "unseen-area", "sheet-thickness")},
    "hull": {"hull-daylight-votes": "daylight-votes"},
    "radiance": {
        "ghost-batch": "batch",
        "ghost-sheets": "layers",
        "ghost-lr": "lr",
        "ghost-smoothing": "smoothing",
    },
    "openings": {
        f"ghost-{name}": name
        for name in ("iterations", "mask", "daylight", "binary", "closing", "chroma", "rounds")
    },
    "cavities": {f"carving-{name}": name for name in ("iterations", "batch", "lr", "radiance-lr")},
    "refinement": {
        f"refinement-{name}": name
        for name in ("iterations", "lr", "smoothing", "detail", "radiance-lr", "outline")
    },
    "folds": {f"folds-{name}": name for name in ("iterations", "lr", "detail", "descent")},
    "volume": {
        f"volume-{name}": name
        for name in (
            "iterations",
            "side",
            "resolution",
            "batch",
            "density-lr",
            "radiance-lr",
            "direction-lr",
            "mask",
            "distortion",
        )
    },
    "render": {"step-views": "views"}
    | {name: name for name in ("spp", "primal-spp", "max-depth", "gradient-depth", "reparam-depth")},
    "model": {name: name for name in ("field", "light-height")}
    | {"flexicubes-weights": "field flexicubes", "no-even-start": "no-even-start"},
    "losses": {"image-loss": "image", "joint-mask": "mask", "joint-depth": "depth"}
    | {name: name for name in ("material-smoothness", "light-grey", "flexicubes-deviation")}
    | {
        name: f"extra {name.replace('-', '_')}"
        for name in (
            "hole-opening",
            "hole-closing",
            "visible-outside",
            "visible-inside",
            "sdf-sign",
            "eikonal",
            "template-smoothness",
            "albedo-chroma",
            "light-smoothness",
        )
    },
    "joint": {"material-gradient-smoothing": "material-smoothing"}
    | {
        name: name
        for name in (
            "warmup",
            "geometry-lr",
            "msdf-lr",
            "deform-lr",
            "geometry-smoothing",
            "geometry-detail",
            "material-lr",
            "color-hold",
            "light-lr",
        )
    },
    "detail": {"detail-iterations": "iterations"},
}

#: Flags that nothing has taken the place of.
GONE = (
    "color-voxels",
    "ghost-gain",
    "vessel-gain",
    "refinement-gain",
    "folds-gain",
    "second-look",
    "second-look-gain",
    "joint.revision",
    "joint.revision-gain",
)

#: The new flag of each old one, without dashes.
RENAMED = {
    old: f"{group}.{new}" if group else new for group, names in _MOVED.items() for old, new in names.items()
}


def check_flags(words: Iterable[str]) -> None:
    """Raises a ``UserError`` if one of a command's words is a flag of another name now, or of none.

    >>> check_flags(["--joint.warmup", "0.2"])
    >>> check_flags(["--warmup=0.2"])
    Traceback (most recent call last):
    gshell_mi.errors.UserError: --warmup is called --joint.warmup now; --help lists all settings.
    """
    for word in words:
        name = word.partition("=")[0].removeprefix("--").replace("_", "-")
        if word.startswith("--") and name in GONE:
            raise UserError(f"--{name} is gone, as one judge decides what is kept; leave it out.")
        if word.startswith("--") and name in RENAMED:
            raise UserError(f"--{name} is called --{RENAMED[name]} now; --help lists all settings.")
