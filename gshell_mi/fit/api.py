"""A whole run of a fit: the stages, and then what is written of their result."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from .. import extras  # noqa: F401 registers what settings may name
from ..errors import UserError
from ..export import FitFolder, export_fit, write_metrics
from ..export.asset import NO_ATLAS, write_asset
from ..interrupt import Interrupt
from ..memory import GIB, free_memory_of_variant, peak_memory
from ..progress import Progress
from ..report import write_report
from ..scene import load_fit_scene
from ..scene_inputs import scene_inputs
from .bookkeeping.checkpoint import Checkpoint
from .bookkeeping.fingerprint import check_fingerprint, fingerprint
from .bookkeeping.observer import Observer
from .cameras.held_out import held_out_views
from .config import EFFORTS, Effort, FitConfig, default_output
from .fitted import Fitted
from .joint.depth import check_depth
from .lattices import Lattices
from .memory import MemoryEstimate
from .pipeline import pipeline
from .runner import Runner, checkpoint_path
from .scene_checks import check_given, check_names, notes_on_views
from .stage import Fit
from .surface import Surface


@dataclass(frozen=True)
class FitResult:
    """What a fit leaves behind.

    Attributes:
        output: the folder.
        metrics: the contents of ``metrics.json``.
    """

    output: Path
    metrics: dict


def fit_scene(
    scene: str | Path,
    output: str | Path | None = None,
    *,
    targets: str | Path | None = None,
    config: FitConfig | None = None,
    resume: bool = False,
    overwrite: bool = False,
    report: bool = True,
    quiet: bool = True,
    observer: Observer | None = None,
) -> FitResult:
    """Reconstructs the gshell shape of a fit scene, its material and its light.

    A Mitsuba ``llvm`` or ``cuda`` variant must be set.

    Args:
        scene: the fit scene's XML file.
        output: the folder to write; default ``out/<scene stem>``.
        targets: folder of the target images; default beside the XML.
        config: settings.
        resume: continue from the checkpoint in ``output``.
        overwrite: replace an earlier fit in ``output``.
        report: also write ``mesh.glb`` and ``report.html``.
        quiet: no progress bar.
        observer: is told of every step, such as ``viewer.Viewer``.

    Raises:
        UserError: of anything that the user can mend.
    """
    config = config or FitConfig()
    check_names(config)
    scene = Path(scene)
    output = Path(output) if output else default_output(scene)
    with (
        Interrupt() as interrupt,
        Progress(quiet=quiet) as progress,
        FitFolder(output, resume=resume, overwrite=overwrite) as folder,
    ):
        checkpoint = Checkpoint("", 0, config.settings())
        if resume:
            checkpoint = Checkpoint.load(checkpoint_path(folder.place))
            _check_settings(checkpoint.config, config.settings())
        memory = _Memory(config, report, progress)
        with progress.stage("targets", None):
            loaded = load_fit_scene(
                scene,
                Path(targets) if targets else None,
                hold_out=config.hold_out,
                before_targets=memory.check,
                on_reference=progress.reference,
            )
            fit = Fit.of(loaded, config)
            _check_inputs(fit, checkpoint, resume)
            folder.check(
                scene_inputs(scene) | loaded.target_files,
                fit.views.ids,
                [view.sensor.id() for view in loaded.held_out],
            )
        if not fit.pixels.has_alpha:
            progress.warn("some targets have no alpha: coverage is taken as 1 and the mask losses are off.")
        for note in loaded.notes + notes_on_views(loaded):
            progress.warn(note)
        # Nothing is written before all is known to be in order.
        folder.prepare()
        if observer:
            observer.begin(loaded)
        runner = Runner(folder.place, checkpoint, config.checkpoint_seconds, progress, interrupt, observer)
        try:
            stages = pipeline(loaded, fit.lattices, config)
            surface = runner.run(stages, fit, Surface(loaded.subject.fields()))
            interrupt.check()
            metrics = _export(fit, surface, runner, memory, report)
            folder.finish()
        except OSError as error:
            raise UserError(
                f"'{error.filename or folder.place}' cannot be written "
                f"({error.strerror or error}); free some space or mend its permissions, then "
                f"continue with --resume."
            ) from error
        return FitResult(output, metrics)


class _Memory:
    """How much memory a fit needs, and has needed."""

    def __init__(self, config: FitConfig, report: bool, progress: Progress):
        self._config, self._report, self._progress = config, report, progress
        self._estimate = 0

    def check(self, subject: mi.Shape, sensors: list[mi.Sensor]) -> None:
        """Says how much the fit of a gshell shape needs, and refuses it if that much is not free."""
        sizes = np.array([sensor.film().crop_size() for sensor in sensors])
        lattices = Lattices.of(subject, self._config)
        volume = self._config.volume.iterations and not subject.filename
        lattice = lattices.fine if volume else lattices.last
        estimate = MemoryEstimate.of(
            self._config, lattice.resolution, sizes, grid=lattice.grid, report=self._report
        )
        free = free_memory_of_variant()
        told = "" if free is None else f"; {free / GIB:.1f} GiB are free"
        self._progress.tell(f"memory: about {estimate.total / GIB:.1f} GiB{told}")
        estimate.require(free)
        self._estimate = estimate.total

    def metrics(self) -> dict[str, int]:
        """Entries of ``metrics.json``."""
        mib = {"estimated_memory_mib": self._estimate, "peak_memory_mib": peak_memory()}
        return {name: round(size / 2**20) for name, size in mib.items()}


def _check_inputs(fit: Fit, checkpoint: Checkpoint, resume: bool) -> None:
    """Refuses scenes that cannot be fitted, and other ones than the checkpoint's."""
    check_given(fit.scene, fit.config)
    check_depth(fit.scene, fit.views)
    found = fingerprint(fit.scene, fit.lattices.last)
    if resume:
        check_fingerprint(checkpoint.inputs, found)
    checkpoint.inputs = found


def _check_settings(before: dict[str, Any], now: dict[str, Any]) -> None:
    changed = {name: value for name, value in now.items() if before.get(name) != value}
    changed.pop("checkpoint_seconds", None)
    if not changed:
        return
    name, value = next(iter(changed.items()))
    told = f"{name} = {before.get(name)}, not {'the default' if value is None else value}"
    if (effort := _effort_of(before)) != (given := _effort_of(now)):
        told = f"--effort {effort}, not {given}"
    raise UserError(
        f"The checkpoint was made with {told}; resume with the same settings or start again with --overwrite."
    )


def _effort_of(settings: dict[str, Any]) -> Effort:
    """The effort whose settings these are, or nearly are."""

    def differing(effort: Effort) -> int:
        return sum(settings.get(name) != value for name, value in EFFORTS[effort].settings().items())

    return min(EFFORTS, key=differing)


def _export(fit: Fit, surface: Surface, runner: Runner, memory: _Memory, report: bool) -> dict:
    """Writes what a fit has found; returns the metrics."""
    output, progress, checkpoint = runner.output, runner.progress, runner.checkpoint
    fit = fit.corrected(dataclasses.replace(surface, gains=None))
    laid = []
    if fit.scene.held_out and surface.poses is not None:
        with progress.stage("held out", None), runner.timed("held_out"):
            laid = held_out_views(fit, surface)
    with progress.stage("export", None), runner.timed("export"):
        fitted = Fitted.of(fit, surface)
        metrics = export_fit(
            output,
            fit.scene,
            fitted.material,
            fitted.light,
            fit.config.triptychs,
            fitted.texture,
            fitted.texture_levels,
            light_turns=fit.light_turns,
            gains=surface.gains,
            laid=laid,
        )
        metrics["light_frame"] = "camera" if fit.light_turns else "world"
        metrics["config"] = dataclasses.asdict(fit.config)
        metrics |= fitted.findings(fit, progress.warn) | {"warnings": progress.warnings}

    def write() -> dict:
        return write_metrics(output, metrics | checkpoint.facts | memory.metrics(), checkpoint.seconds)

    written = write()
    if report:
        _write_documents(runner)
        written = write()
    return written


def _write_documents(runner: Runner) -> None:
    """The asset and the report; for want of them a fit is not lost."""
    try:
        with runner.progress.stage("mesh.glb", None), runner.timed("asset"):
            if not write_asset(runner.output)["charts"]:
                runner.progress.warn(NO_ATLAS)
        with runner.progress.stage("report", None), runner.timed("report"):
            write_report(runner.output)
    except UserError as error:
        runner.progress.warn(str(error))
