"""Fits with their scores, kept on disk: what exists is not done again, what was interrupted goes on."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from functools import cache
from pathlib import Path

import gshell_mi
from gshell_mi.compare import compare_fit
from gshell_mi.errors import UserError
from gshell_mi.export.fitted_scene import load_scene
from gshell_mi.files import replacing
from gshell_mi.fit import FitConfig, fit_scene
from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint
from gshell_mi.scene import render_missing_targets

from .stage_scores import StageScores


@dataclass(frozen=True)
class Trial:
    """A fit to make and to score."""

    scene: Path
    name: str
    config: FitConfig
    truth: Path | None = None
    """The folder that holds ``truth.ply``, ``test.xml`` and ``reference.xml``; default: the scene's."""

    @property
    def truth_folder(self) -> Path:
        return self.truth or self.scene.with_suffix("")

    def record(self, output: Path) -> Path:
        """The file that holds its outcome."""
        return output / self.scene.stem / f"{self.name}.json"


@dataclass(frozen=True)
class Outcome:
    """What came of a trial."""

    config: dict
    scores: dict
    """``mean`` of the image scores over the test views and ``mesh`` scores, as ``compare`` gives them."""
    cpu_seconds: float | None
    """Of the fit, over all threads; None if it was interrupted, as only the last part is known then."""
    wall_seconds: float
    """Of the stages' timings, added up over interruptions."""
    code: str
    """``code_version`` of the package that made the fit."""
    error: str | None = None
    """Why there is no surface to score."""
    stages: dict = dataclasses.field(default_factory=dict)
    """By stage, in their order: ``seconds`` and the ``mesh`` scores after it; empty if it was interrupted."""


def load_outcome(trial: Trial, output: Path) -> Outcome | None:
    """The outcome on disk; None if there is none or if it was made with other settings."""
    try:
        found = Outcome(**json.loads(trial.record(output).read_text()))
    except (OSError, ValueError, TypeError):
        return None
    return found if found.config == _plain(trial.config) else None


def is_done(trial: Trial, output: Path) -> bool:
    """Whether there is an outcome to keep; what failed is tried again, as its cause may be mended."""
    found = load_outcome(trial, output)
    return found is not None and not found.error


def run_trial(trial: Trial, output: Path, *, quiet: bool = True) -> Outcome:
    """Fits and scores, or loads what exists. The fit's folder lies beside the record.

    Raises:
        UserError: the scene lacks what scoring needs. A fit that fails is an outcome.
    """
    if is_done(trial, output):
        return load_outcome(trial, output)
    inside = trial.truth_folder
    for needed in (inside / "truth.ply", inside / "test.xml", inside / "reference.xml"):
        if not needed.is_file():
            raise UserError(f"'{needed}' is missing; a scene of a study needs it to be scored.")
    folder = output / trial.scene.stem / trial.name
    resume = _same_settings(folder / "checkpoint.npz", trial.config)
    if trial.truth is None:
        _render_views(inside / "reference.xml", trial.scene, inside)
    code, before = code_version(), time.process_time()
    watcher = StageScores(inside / "truth.ply")
    try:
        fitted = fit_scene(
            trial.scene,
            folder,
            config=trial.config,
            resume=resume,
            overwrite=not resume,
            report=False,
            quiet=quiet,
            observer=watcher,
        )
        seconds = time.process_time() - before - watcher.cpu_seconds
        targets = inside / "test"
        if not targets.is_dir():
            targets = output / trial.scene.stem / "test_views"
        _render_views(inside / "reference.xml", inside / "test.xml", targets)
        scores = compare_fit(folder, targets=targets, sensors=inside / "test.xml", mesh=inside / "truth.ply")
        outcome = Outcome(
            _plain(trial.config),
            {"mean": scores["mean"], "mesh": scores["mesh"]},
            None if resume else round(seconds, 1),
            fitted.metrics["seconds"]["total"],
            code,
            stages={} if resume else watcher.with_seconds(fitted.metrics["seconds"]),
        )
    except UserError as error:
        outcome = Outcome(_plain(trial.config), {}, None, 0.0, code, str(error))
    record = trial.record(output)
    record.parent.mkdir(parents=True, exist_ok=True)
    with replacing(record) as partial:
        partial.write_text(json.dumps(dataclasses.asdict(outcome), indent=1) + "\n")
    return outcome


def run_trials(trials: list[Trial], output: Path, *, quiet: bool = True) -> Iterator[tuple[Trial, Outcome]]:
    """Runs one trial after another, telling on the terminal how each went and how long the rest may take.

    The time left is the median of the fits of this run times the number that is left.
    """
    todo = sum(not is_done(trial, output) for trial in trials)
    print(f"{len(trials)} fits, {len(trials) - todo} of them exist already.", flush=True)
    durations = []
    for number, trial in enumerate(trials, 1):
        new = not is_done(trial, output)
        begin = time.monotonic()
        outcome = run_trial(trial, output, quiet=quiet)
        left = ""
        if new:
            durations.append(time.monotonic() - begin)
            todo -= 1
            rest = timedelta(seconds=round(todo * statistics.median(durations)))
            left = f"  [{durations[-1]:.0f} s; about {rest} left]"
        title = f"{number}/{len(trials)} {trial.scene.stem}, {trial.name}"
        print(f"{title}: {summary(outcome)}{left}", flush=True)
        yield trial, outcome


@cache
def code_version() -> str:
    """A digest of the package's source: fits of different versions should not be compared."""
    digest = hashlib.sha256()
    for path in sorted(Path(gshell_mi.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def summary(outcome: Outcome) -> str:
    """The outcome in one line."""
    if outcome.error:
        return f"failed: {outcome.error}"
    mesh, loops = outcome.scores["mesh"], outcome.scores["mesh"]["boundary_loops"]
    return (
        f"loops {loops['found']} of {loops['reference']}, chamfer {mesh['chamfer']:.3f} %, "
        f"{outcome.scores['mean']['psnr']:.2f} dB"
    )


def _render_views(reference: Path, sensors: Path, folder: Path) -> None:
    """The views of the scene file ``sensors`` that are not in ``folder`` yet; no part of any fit's time."""
    folder.mkdir(parents=True, exist_ok=True)
    render_missing_targets(reference, folder, load_scene(sensors).sensors())


def _same_settings(checkpoint: Path, config: FitConfig) -> bool:
    """Whether there is an interrupted fit with these settings."""
    if not checkpoint.is_file():
        return False
    try:
        return Checkpoint.load(checkpoint).config == json.loads(json.dumps(config.settings()))
    except UserError:
        return False


def _plain(config: FitConfig) -> dict:
    # As JSON gives it back: tuples are lists there.
    return json.loads(json.dumps(dataclasses.asdict(config)))
