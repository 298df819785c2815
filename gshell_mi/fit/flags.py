"""Names that settings had before they were sorted by stage: who uses one is told the new one."""

from __future__ import annotations

from collections.abc import Iterable

from ..errors import UserError


def _without(prefix: str, names: str) -> dict[str, str]:
    """Old name, prefixed, and new name of each word."""
    return {prefix + name: name for name in names.split()}


_EXTRA_LOSSES = (
    "hole-opening hole-closing visible-outside visible-inside sdf-sign eikonal "
    "template-smoothness albedo-chroma light-smoothness"
).split()

#: What became of the flags, by the new group: old name, new name.
_MOVED = {
    "": {"preview": "effort preview"},
    "lattice": _without("", "start-resolution band-resolution"),
    "topology": _without("ghost-", "min-area") | _without("", "min-area unseen-area sheet-thickness"),
    "hull": _without("hull-", "daylight-votes"),
    "radiance": _without("ghost-", "batch lr smoothing") | {"ghost-sheets": "layers"},
    "openings": _without("ghost-", "iterations mask daylight binary closing chroma rounds"),
    "cavities": _without("carving-", "iterations batch radiance-lr")
    | dict.fromkeys(("carving-lr", "cavities.lr"), "density-lr"),
    "refinement": _without("refinement-", "iterations lr smoothing detail radiance-lr outline"),
    "folds": _without("folds-", "iterations lr detail descent"),
    "volume": _without(
        "volume-", "iterations side resolution batch density-lr radiance-lr direction-lr mask distortion"
    ),
    "render": {"step-views": "views"} | _without("", "spp primal-spp max-depth gradient-depth reparam-depth"),
    "model": _without("", "field light-height no-even-start") | {"flexicubes-weights": "field flexicubes"},
    "losses": {"image-loss": "image"}
    | _without("joint-", "mask depth")
    | _without("", "material-smoothness light-grey flexicubes-deviation")
    | {name: f"extra {name.replace('-', '_')}" for name in _EXTRA_LOSSES},
    "joint": {"material-gradient-smoothing": "material-smoothing"}
    | _without("", "warmup geometry-lr msdf-lr deform-lr geometry-smoothing geometry-detail")
    | _without("", "material-lr color-hold light-lr"),
    "detail": _without("detail-", "iterations"),
}

#: Flags that nothing has taken the place of.
GONE = (
    "color-voxels ghost-gain vessel-gain refinement-gain folds-gain second-look second-look-gain "
    "joint.revision joint.revision-gain"
).split()

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
