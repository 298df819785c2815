"""The profile of an iteration: its phases, and what is made of them."""

import sys
from pathlib import Path

import numpy as np
import pytest
from bowl import CLOSED, SHORT

sys.path.insert(0, str(Path(__file__).parents[2] / "pipelines"))
import profile_iteration

from gshell_mi.fit import FitConfig
from gshell_mi.fit.joint.config import ModelConfig, RenderConfig
from gshell_mi.fit.joint.joint import JointStage
from gshell_mi.light import EnvironmentLight
from gshell_mi.material import MaterialField
from gshell_mi.scene import load_fit_scene


def test_phases_of_a_step(bowl_scene):
    fit = load_fit_scene(bowl_scene)
    material = MaterialField(np.full((fit.subject.lattice.vertex_count, 3), 0.5))
    joint = JointStage(
        fit,
        material,
        EnvironmentLight.uniform(4, 1.0),
        FitConfig(
            iterations=10,
            render=RenderConfig(spp=1, primal_spp=1, max_depth=2),
            model=ModelConfig(light_height=4),
        ),
    )
    seconds, free = profile_iteration.seconds_per_phase(joint, 2, 1, iter(range(1000)).__next__)
    assert set(seconds) == {
        "extraction",
        "scene update",
        "render",
        "losses",
        "backward",
        "render backward",
        "optimiser",
    }
    assert free == 1 and min(seconds.values()) > 0


def test_goes_on_from_a_finished_fit(bowl_scene, tmp_path):
    from gshell_mi.fit.__main__ import main

    assert main([str(bowl_scene), "-o", str(tmp_path), "--quiet", *SHORT, *CLOSED]) == 0
    joint = profile_iteration.joint_stage(bowl_scene, tmp_path)
    assert joint.iterations == 12 and joint.step(12)["psnr"] > 20


def test_table():
    text = profile_iteration.table({"render": 0.5, "render backward": 0.3, "optimiser": 0.2}, 0.9)
    rows = text.splitlines()
    assert rows[2] == "| render | 500 | 50.0% |" and rows[4] == "| optimiser | 200 | 20.0% |"
    assert "Everything but rendering: 20.0%" in rows[-1] and "900 ms" in rows[-1]


def test_folder_without_a_fit(bowl_scene, tmp_path):
    from gshell_mi import UserError

    with pytest.raises(UserError, match="no checkpoint"):
        profile_iteration.joint_stage(bowl_scene, tmp_path)
