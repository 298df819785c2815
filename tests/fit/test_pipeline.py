"""Which stages a fit has, and what they need."""

import subprocess
import sys
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from gshell_mi import extras  # noqa: F401 registers parametrisations
from gshell_mi.fields import LatticeFields, sphere
from gshell_mi.fit import FitConfig
from gshell_mi.fit.lattices import Lattices
from gshell_mi.fit.pipeline import pipeline
from gshell_mi.lattice import TetLattice

VOLUME = ["volume", "fine_folds"]
LAST = ["smoothing", "texture"]
END = ["poses", "revision", "detail", "alignment", "rims", *LAST]
START = ["light", "openings", "exposures", "cavities", "refinement", "folds", "revoxelise"]
KEPT = [stage for stage in START if stage != "exposures"]
GEOMETRY = [stage for stage in KEPT if stage != "light"]


def names(subject: mi.Shape, settings: dict) -> list[str]:
    config = FitConfig().changed(settings)
    stages = pipeline(SimpleNamespace(subject=subject), Lattices.of(subject, config), config)
    return [stage.name for stage in stages]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, ["occlusion", "hull", *START, *VOLUME, "joint", *END]),
        ({"volume.iterations": 0}, ["occlusion", "hull", *START, "joint", *END]),
        ({"iterations": 0}, ["occlusion", "hull", *START, *VOLUME, "joint"]),
        ({"detail.iterations": 0}, ["occlusion", "hull", *START, *VOLUME, "joint", *LAST]),
        ({"model.field": "hashgrid"}, ["occlusion", "hull", *START, *VOLUME, "joint", *LAST]),
        ({"exposures": "keep"}, ["occlusion", "hull", *KEPT, *VOLUME, "joint", *END]),
        ({"geometry_only": True}, ["occlusion", "hull", *GEOMETRY, *VOLUME, "joint", *END]),
        ({"light_frame": "world"}, ["occlusion", "hull", *START[1:], *VOLUME, "joint", *END]),
        ({"known_light": True}, ["occlusion", "hull", *START[1:], *VOLUME, "joint", *END]),
        ({"occlusion.most": 0.0}, ["hull", *START, *VOLUME, "joint", *END]),
        (
            {"poses": "keep"},
            ["occlusion", "hull", *START, *VOLUME, "joint", "revision", "detail", "rims", *LAST],
        ),
        (
            {"openings.revise": False},
            [
                "occlusion",
                "hull",
                *START,
                *VOLUME,
                "joint",
                "poses",
                "detail",
                "alignment",
                "smoothing",
                "texture",
            ],
        ),
        (
            {"texture.rounds": 0},
            [
                "occlusion",
                "hull",
                *START,
                *VOLUME,
                "joint",
                "poses",
                "revision",
                "detail",
                "alignment",
                "rims",
                "smoothing",
            ],
        ),
        ({"model.field": "flexicubes"}, ["occlusion", "hull", *START, *VOLUME, "joint", *END]),
    ],
)
def test_stages_from_masks(settings, expected):
    assert names(mi.load_dict({"type": "gshell", "resolution": 12}), settings) == expected


@pytest.mark.parametrize(
    ("opened", "settings", "expected"),
    [
        (True, {}, ["given", "light", "exposures", "joint", "poses", "detail", "alignment", *LAST]),
        (True, {"exposures": "keep"}, ["given", "light", "joint", "poses", "detail", "alignment", *LAST]),
        (False, {}, ["given", *START, "joint", "poses", "detail", "alignment", *LAST]),
        (True, {"watertight": True}, ["given", *START, "joint", "poses", "detail", "alignment", *LAST]),
    ],
)
def test_stages_from_given_fields(tmp_path, opened, settings, expected):
    ball = sphere(TetLattice(12))
    msdf = ball.msdf - 2 * np.float32(opened)
    LatticeFields(ball.sdf, msdf, ball.deform).save(tmp_path / "fields.npz")
    subject = mi.load_dict({"type": "gshell", "filename": str(tmp_path / "fields.npz")})
    assert names(subject, settings) == expected


def test_no_stage_needs_what_is_made_of_a_fit():
    """A fit in a program of its own has neither a report, nor films, nor a page."""
    code = """if True:
        import sys
        import gshell_mi.fit, gshell_mi.fit.pipeline, gshell_mi.fit.runner, gshell_mi.fit.fitted
        above = {f"gshell_mi.{room}" for room in ("export", "report", "turntable", "viewer", "capture")}
        assert not above & set(sys.modules), above & set(sys.modules)
        from gshell_mi.fit import FitResult, fit_scene
        assert "gshell_mi.report" in sys.modules
    """
    subprocess.run([sys.executable, "-c", code], check=True)
