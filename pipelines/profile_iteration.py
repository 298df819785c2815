"""Where the time of a joint-stage iteration goes, as a table in Markdown.

    python pipelines/profile_iteration.py SCENE.xml OUT     # OUT: the folder of a finished fit of that scene

The iterations start from the fit's last geometry, material and light. Every phase is computed and waited for
before the next begins, so their sum is somewhat more than an iteration of a fit, which is timed too. On a
machine that is busy with other work ``--cpu`` counts processor time, summed over threads, instead.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import drjit as dr

from gshell_mi.doctor import ensure_variant

#: Steps before the clock starts, which compile kernels.
_WARM_UP = 4

#: Phases that are rendering.
_RENDERING = ("render", "render backward")


def joint_stage(scene: Path, output: Path):
    """The joint stage of a finished fit, as its checkpoint has it."""
    from gshell_mi.fit import FitConfig
    from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint
    from gshell_mi.fit.fitted import Fitted
    from gshell_mi.fit.joint.joint import JointStage
    from gshell_mi.fit.stage import Fit
    from gshell_mi.fit.surface import Surface
    from gshell_mi.scene import load_fit_scene

    loaded = load_fit_scene(scene)
    checkpoint = Checkpoint.load(output / "checkpoint.npz")
    config = FitConfig().changed(checkpoint.config)
    surface = Surface.from_arrays(checkpoint.arrays)
    fit = Fit.of(loaded, config).corrected(surface)
    fitted = Fitted.of(fit, surface)
    return JointStage(fit.scene, fitted.material, fitted.light, config, turns=fit.views.turns)


def seconds_per_phase(
    joint, first: int, count: int, clock: Callable[[], float]
) -> tuple[dict[str, float], float]:
    """Mean seconds per phase of an iteration, and of an iteration that nobody interrupts."""
    from gshell_mi.timing import Stopwatch

    free = clock()
    for step in range(first, first + count):
        joint.step(step)
    dr.sync_thread()
    free = (clock() - free) / count
    with Stopwatch(clock) as watch:
        for step in range(first + count, first + 2 * count):
            joint.step(step)
    return {name: seconds / count for name, seconds in watch.seconds.items()}, free


def table(seconds: dict[str, float], free: float) -> str:
    """The table, its phases by share, and what is left beside rendering."""
    total = sum(seconds.values())
    rows = ["| phase | ms | share |", "|---|---|---|"]
    for name, spent in sorted(seconds.items(), key=lambda item: -item[1]):
        rows.append(f"| {name} | {1e3 * spent:.0f} | {spent / total:.1%} |")
    others = 1 - sum(seconds.get(name, 0) for name in _RENDERING) / total
    rows += [
        "",
        f"Everything but rendering: {others:.1%}. An iteration without the stopwatch takes "
        f"{1e3 * free:.0f} ms, with it {1e3 * total:.0f} ms.",
    ]
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("output", type=Path, help="folder of a finished fit of the scene")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--steps", type=int, default=24, help="iterations that are timed")
    parser.add_argument("--cpu", action="store_true", help="processor time instead of wall time")
    given = parser.parse_args()
    ensure_variant(given.variant)
    joint = joint_stage(given.scene, given.output)
    last = joint.iterations
    for step in range(last, last + _WARM_UP):
        joint.step(step)
    clock = time.process_time if given.cpu else time.perf_counter
    print(table(*seconds_per_phase(joint, last + _WARM_UP, given.steps, clock)))


if __name__ == "__main__":
    main()
