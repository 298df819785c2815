"""The estimate of a fit's memory: what it grows with, and what is refused."""

import json
import shutil

import numpy as np
import pytest
from bowl import CLOSED, SHORT

from gshell_mi import UserError, memory
from gshell_mi.fit import FitConfig
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.joint.config import RenderConfig
from gshell_mi.fit.memory import MemoryEstimate
from gshell_mi.fit.stages.volume import VolumeConfig

SIZES = np.full((48, 2), 256)


def test_targets_grow_with_pixels_and_the_lattice_with_cells():
    one, two = (MemoryEstimate.of(FitConfig(), 64, np.full((n, 2), 256)) for n in (48, 96))
    assert two.targets == 2 * one.targets and two.samples == one.samples
    fine = MemoryEstimate.of(
        FitConfig().changed({"lattice.start_resolution": 128, "lattice.band_resolution": 800}), 128, SIZES
    )
    assert 4 < fine.lattice / one.lattice < 8, "between the surface and the volume"
    fine, finest = (MemoryEstimate.of(FitConfig(), resolution, SIZES).lattice for resolution in (256, 512))
    assert finest < 4 * fine, "in blocks it follows the surface"
    double = FitConfig(render=RenderConfig(primal_spp=12))
    assert MemoryEstimate.of(double, 64, SIZES).samples == 2 * one.samples
    mixed = np.array([[100, 200], [400, 300]])
    assert MemoryEstimate.of(FitConfig(), 64, mixed).samples == one.samples * 120000 // 256**2


def test_what_does_not_run_takes_nothing():
    config = FitConfig().changed({"cavities.batch": 10**9, "volume.batch": 10**9, "cameras.places": 10**9})
    off = {"cavities.iterations": 0, "volume.iterations": 0, "poses": "keep"}
    least = MemoryEstimate.of(FitConfig().changed(off), 64, SIZES).rays
    for name in off:
        but_one = {other: given for other, given in off.items() if other != name}
        assert MemoryEstimate.of(config.changed(but_one), 64, SIZES).rays > 100 * least
    assert MemoryEstimate.of(config.changed(off), 64, SIZES).rays == least


@pytest.mark.parametrize(
    ("config", "resolution", "sizes", "cure"),
    [
        (FitConfig(), 512, SIZES, "lower --resolution"),
        (FitConfig(), 64, np.full((400, 2), 1000), "use fewer or smaller views"),
        (FitConfig(), 64, np.full((400, 2), 64), "lower --resolution or use fewer views"),
        (
            FitConfig(render=RenderConfig(primal_spp=512)),
            64,
            SIZES,
            "lower --render.primal-spp and --render.spp",
        ),
        (FitConfig(volume=VolumeConfig(iterations=0)), 16, SIZES[:2], "close other programs"),
        (FitConfig(), 16, SIZES[:2], "lower --volume.side"),
        (FitConfig().changed({"model.light_height": 100_000}), 64, SIZES, "lower --model.light-height"),
        *(
            (FitConfig().changed({name: 10**9}), 64, SIZES, "lower --radiance.batch, --cavities.batch, ")
            for name in ("radiance.batch", "cavities.batch", "volume.batch", "cameras.places")
        ),
    ],
)
def test_the_cure_is_for_what_takes_most(config, resolution, sizes, cure):
    estimate = MemoryEstimate.of(config, resolution, sizes)
    estimate.require(estimate.total)
    estimate.require(None)
    with pytest.raises(UserError, match=rf"The fit needs about .* GiB .* are free; {cure}.* GiB\.$"):
        estimate.require(estimate.total - 1)


def test_absurd_numbers_of_views_are_those_that_there_are():
    """They take no memory."""
    many = FitConfig(triptychs=10**12).changed({"gains.places": 10**12})
    assert MemoryEstimate.of(many, 64, SIZES) == MemoryEstimate.of(FitConfig(), 64, SIZES)


def test_a_fit_that_cannot_fit_is_refused_before_it_reads_targets(bowl_scene, tmp_path, monkeypatch, capfd):
    shutil.copy(bowl_scene, tmp_path / "bowl.xml")  # without its targets
    monkeypatch.setattr(memory, "free_memory", lambda: 2 * memory.GIB)
    given = [str(tmp_path / "bowl.xml"), "-o", str(tmp_path / "out"), "--resolution", "400"]
    assert main(given) == 2
    told = capfd.readouterr().err
    assert "memory: about" in told and "2.0 GiB are free" in told
    assert "error: The fit needs about" in told and "lower --resolution" in told
    assert not (tmp_path / "out").exists()


def test_a_scene_whose_lattice_cannot_fit(bowl_scene, tmp_path, monkeypatch, capfd):
    text = bowl_scene.read_text()
    assert '"resolution" value="20"' in text
    (tmp_path / "bowl.xml").write_text(text.replace('"resolution" value="20"', '"resolution" value="700"'))
    monkeypatch.setattr(memory, "free_memory", lambda: 2 * memory.GIB)
    assert main([str(tmp_path / "bowl.xml"), "-o", str(tmp_path / "out")]) == 2
    told = capfd.readouterr().err
    assert "A lattice of 700 cells per side needs about 10.3 GiB of memory, and 2.0 GiB are free" in told


def test_metrics_hold_estimate_and_peak(bowl_scene, tmp_path):
    output = tmp_path / "out"
    assert main([str(bowl_scene), "-o", str(output), "--quiet", *SHORT, *CLOSED, "--iterations", "1"]) == 0
    metrics = json.loads((output / "metrics.json").read_text())
    assert metrics["peak_memory_mib"] == pytest.approx(memory.peak_memory() / 2**20, rel=0.2)
    assert 280 < metrics["estimated_memory_mib"] < 1000
