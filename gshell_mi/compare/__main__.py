"""``python -m gshell_mi.compare``: scores on the screen, as JSON and as error images."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from ..bars import Bars
from ..command_line import run_command
from ..errors import UserError
from ..evaluation import IMAGE_SCORES, Scores
from ..evaluation.scores_file import check_scores_file, write_scores
from ..wording import counted

#: Characters of a line in a file or a pipe, where no heading has to be cut.
_WIDE = 160

_MESHES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")


@dataclass(frozen=True)
class _Arguments:
    first: tyro.conf.Positional[Path]
    """What is judged: the folder of a fit, an EXR file, a folder of EXR files, or a mesh file."""
    second: tyro.conf.Positional[Path | None] = None
    """The reference: an EXR file, a folder of EXR files or a mesh file. A fit needs none."""
    targets: Path | None = None
    """Of a fit: folder of the images <sensor id>.exr; default: those it was made from."""
    sensors: Path | None = None
    """Of a fit: scene file with other sensors, such as held-out views; then --targets names their images."""
    envmap: Path | None = None
    """Of a fit: render under this environment map (EXR) instead of the fitted light; the scores come raw and
    after the best factor per colour channel on the albedo."""
    mesh: Path | None = None
    """Of a fit: the true surface, to score the geometry as well."""
    spp: int = 64
    """Of a fit: samples per pixel."""
    json: Path | None = None
    """File for the scores; one of an earlier comparison is replaced."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder for error images: reference, result and FLIP map side by side; earlier ones are replaced."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant: llvm_ad_rgb (CPU) or cuda_ad_rgb (NVIDIA GPU)."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run_command(
        "compare", "Score images, a fit or a mesh against a reference.", _Arguments, _score, arguments
    )


def _score(given: _Arguments) -> None:
    try:
        if given.json:
            check_scores_file(given.json)
        result = _compare(given)
        if given.json:
            write_scores(given.json, result)
    except OSError as error:
        raise UserError(
            f"'{error.filename or given.output}' cannot be written "
            f"({error.strerror or error}); choose another place."
        ) from error
    unmatched = result.get("unmatched")
    if unmatched:
        some = ", ".join(unmatched[:3]) + (" ..." if len(unmatched) > 3 else "")
        print(
            f"warning: {counted(len(unmatched), 'image')} without a partner of the same name not compared: "
            f"{some}.",
            file=sys.stderr,
        )
    _show(result)


def _compare(given: _Arguments) -> dict:
    from .compare import compare_fit, compare_folders, compare_meshes

    if given.second is None:
        if not given.first.exists():
            raise UserError(f"'{given.first}' does not exist; check the path.")
        if not given.first.is_dir():
            raise UserError(f"'{given.first}' is compared with nothing; give the reference after it.")
        if given.spp < 1:
            raise UserError(f"--spp must be at least 1, not {given.spp}.")
        if given.sensors and not given.targets:
            raise UserError("--sensors names other views than the fit's; give their images with --targets.")
        if given.envmap and not given.targets:
            raise UserError("--envmap relights the fit; give the images under that light with --targets.")
        with Bars(transient=True) as bars:
            task = bars.add_task("views")
            return compare_fit(
                given.first,
                targets=given.targets,
                sensors=given.sensors,
                envmap=given.envmap,
                mesh=given.mesh,
                spp=given.spp,
                errors=given.output,
                progress=lambda done, total: bars.update(task, completed=done, total=total),
            )
    for name in ("targets", "sensors", "envmap", "mesh"):
        if getattr(given, name):
            raise UserError(f"--{name} is for fits only; leave it out, or leave out '{given.second}'.")
    kinds = [path.suffix.lower() in _MESHES for path in (given.first, given.second)]
    if all(kinds):
        return compare_meshes(given.first, given.second)
    if any(kinds):
        raise UserError(f"Of '{given.first}' and '{given.second}' only one is a mesh; give two of a kind.")
    return compare_folders(given.first, given.second, given.output)


def _show(result: dict) -> None:
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = _WIDE
    if "mean" in result:
        table = Table("", *IMAGE_SCORES)
        for name, scores in result["views"].items():
            table.add_row(name, *_row(scores))
        table.add_section()
        table.add_row("mean (raw)" if "mean_albedo_scaled" in result else "mean", *_row(result["mean"]))
        if "mean_albedo_scaled" in result:
            table.add_row("mean (albedo scaled)", *_row(result["mean_albedo_scaled"]))
        console.print(table)
        if "albedo_scale" in result:
            console.print("albedo scale (R, G, B):", ", ".join(f"{x:.3f}" for x in result["albedo_scale"]))
    if "mesh" in result:
        table = Table("surface", "found", "reference")
        for name, value in result["mesh"].items():
            if isinstance(value, dict):
                table.add_row(name, *(f"{value[key]:g}" for key in ("found", "reference")))
            else:
                table.add_row(name, f"{value:.4f}", "")
        console.print(table)


def _row(scores: Scores) -> list[str]:
    return [
        "–"
        if (score := scores[name]) is None
        else f"{score:.2f}"
        if name in ("psnr", "psnr_inside", "delta_e")
        else f"{score:.4f}"
        for name in IMAGE_SCORES
    ]


if __name__ == "__main__":
    sys.exit(main())
