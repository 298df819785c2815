"""What a target does not know of makes no difference, whatever is there."""

import dataclasses

import numpy as np
import pytest
from silent_steps import Silent

from gshell_mi.fit.joint.joint import JointStage
from gshell_mi.fit.stage import Fit
from gshell_mi.fit.stages.hull import Hull
from gshell_mi.fit.stages.joint import start_light, start_material
from gshell_mi.fit.surface import Seen


def hidden(fit: Fit, color: float, alpha: float, *, told: bool) -> Fit:
    """Something stands before the lower half of every other image."""
    targets = []
    for index, target in enumerate(fit.scene.targets):
        rgba, known = target.rgba.copy(), np.ones(target.rgba.shape[:2], np.float32)
        if index % 2:
            lower = slice(len(rgba) // 2, None)
            rgba[lower] = [color, color, color, alpha]
            known[lower] = 0
        targets.append(dataclasses.replace(target, rgba=rgba, known=known if told else None))
    return Fit(dataclasses.replace(fit.scene, targets=targets), fit.config, fit.lattices)


def volume(surface) -> int:
    return int((surface.fields.sdf < 0).sum())


def test_what_hides_the_object_does_not_carve_it(exact):
    whole, told, untold = (
        volume(Hull(exact.config.hull).run(fit, None, Silent()))
        for fit in (exact, hidden(exact, 0, 0, told=True), hidden(exact, 0, 0, told=False))
    )
    assert whole <= told < 1.3 * whole and untold < 0.8 * whole


def test_losses_of_the_joint_stage_do_not_depend_on_it(exact):
    losses = []
    for color, alpha in ((0.0, 0.0), (0.9, 1.0)):
        fit = hidden(exact, color, alpha, told=True)
        surface = Hull(fit.config.hull).run(exact, None, Silent())
        count = len(surface.fields.sdf)
        surface = dataclasses.replace(
            surface, seen=Seen(np.full((count, 3), 0.4, np.float32), np.ones(count, bool), np.float32(0.8))
        )
        fit.scene.subject.set_fields(surface.fields)
        joint = JointStage(
            fit.scene,
            start_material(fit.scene, surface, surface.lattice, fit.config),
            start_light(fit.scene, surface, fit.config),
            fit.config,
            iterations=4,
        )
        losses.append([joint.step(step) for step in range(3)])
    for first, second in zip(*losses, strict=True):
        assert first == pytest.approx(second, rel=1e-3)
    assert losses[0][1]["image"] > 0
