"""The fit from start to end on the bowl: what it leaves behind, what it may read, what a kill costs."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from bowl import CLOSED, RADIUS, SHORT, SIZE, VIEWS, write_fit_scene, write_scene
from topology import assert_manifold, loop_count

from gshell_mi.fit.__main__ import main
from gshell_mi.fit.config import FitConfig


def fit(scene: Path, output: Path, *arguments: str) -> int:
    return main([str(scene), "-o", str(output), "--quiet", *SHORT, *arguments])


#: Views that leave no doubt that the bowl is open; of those twelve it is a close call.
MANY = 20

COMMAND = ("-m", "gshell_mi.fit")
ONE_THREAD = (str(Path(__file__).parents[2] / "pipelines" / "one_thread_fit.py"),)


def start(scene: Path, output: Path, *arguments: str, program: tuple[str, ...] = COMMAND) -> subprocess.Popen:
    """The command in a process of its own, to be killed."""
    command = [sys.executable, *program, str(scene), "-o", str(output), *SHORT, *arguments]
    # A shell starts background jobs with Ctrl-C ignored, and tests may run in one.
    return subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def wait_for_step(process: subprocess.Popen, output: Path, stage: str, iteration: int) -> None:
    """Returns as soon as the log has the step."""
    line, log = f'{{"stage": "{stage}", "iteration": {iteration},', output / "log.jsonl"
    deadline = time.monotonic() + 300
    while not (log.exists() and line in log.read_text()):
        assert process.poll() is None, f"ended before the step: {process.stderr.read()}"
        assert time.monotonic() < deadline
        time.sleep(0.01)


def finish(process: subprocess.Popen) -> None:
    _, told = process.communicate()
    assert process.returncode == 0, told


def log(output: Path) -> list[dict]:
    return [json.loads(line) for line in (output / "log.jsonl").read_text().splitlines()]


def said_of_steps(output: Path) -> list[dict]:
    """The log but for how long the steps took."""
    return [{name: value for name, value in step.items() if name != "seconds"} for step in log(output)]


def steps(output: Path) -> list[tuple[str, int]]:
    return [(step["stage"], step["iteration"]) for step in log(output)]


def mesh(output: Path) -> trimesh.Trimesh:
    return trimesh.load(output / "mesh.ply", process=False)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The folder of a fit that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    output = folder / "out"
    assert fit(write_fit_scene(folder, MANY), output) == 0
    return output


def test_folder_is_complete(whole):
    expected = {
        "scene.xml",
        "mesh.ply",
        "template.ply",
        "light.exr",
        "metrics.json",
        "log.jsonl",
        "checkpoint.npz",
        "views",
    }
    assert expected <= {path.name for path in whole.iterdir()}
    assert not list(whole.glob(".*")), "no partial files"
    shown = {path.stem for path in (whole / "views").iterdir()}
    assert shown < {f"view_{i:03}" for i in range(MANY)} and len(shown) == FitConfig().triptychs


def test_the_bowl_is_open(whole):
    found = mesh(whole)
    assert_manifold(found.vertices, found.faces)
    assert loop_count(found.faces) == 1
    radius = np.linalg.norm(found.vertices, axis=1)
    assert np.median(np.abs(radius - RADIUS)) < 0.05, "half a cell"
    assert found.vertices[:, 1].max() < 0.15
    template = trimesh.load(whole / "template.ply", process=False)
    assert template.is_watertight


def test_metrics(whole):
    metrics = json.loads((whole / "metrics.json").read_text())
    found = mesh(whole)
    assert metrics["counts"]["vertices"] == len(found.vertices)
    assert metrics["counts"]["faces"] == len(found.faces)
    assert metrics["counts"]["boundary_loops"] == 1
    assert metrics["counts"]["nonmanifold_edges"] == 0
    per_view = [scores["psnr"] for scores in metrics["training"]["views"].values()]
    assert metrics["psnr_training"] == pytest.approx(np.mean(per_view), abs=1e-2)
    assert metrics["psnr_training"] > 15
    assert metrics["config"]["openings"]["iterations"] == 100 and metrics["config"]["seed"] == 0
    assert metrics["versions"]["mitsuba"] == mi.__version__
    assert {"hull", "openings", "cavities", "refinement", "joint", "smoothing", "total"} <= set(
        metrics["seconds"]
    )


@pytest.mark.parametrize("kept", [False, True])
def test_metrics_say_whether_the_refinement_was_kept(bowl_scene, tmp_path, decisions, kept):
    decisions(kept)
    assert fit(bowl_scene, tmp_path / "out", *CLOSED, "--iterations", "0") == 0
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["refinement_kept"] is kept


def test_log_has_a_line_per_step(whole):
    # What the judge does not accept at once, it is asked again, after as many steps.
    rounds = sum(stage == "openings" for stage, _ in steps(whole)) // 100
    counts = {"openings": 100 * rounds, "cavities": 10, "refinement": 8, "joint": 12, "revision": 100}
    assert 1 <= rounds <= 1 + FitConfig().openings.rounds
    # The lattice is the joint stage's: there is more to do only where something has changed since.
    metrics = json.loads((whole / "metrics.json").read_text())
    changes = "openings_changed", "recessed_vertices", "dents_filled", "poses_kept"
    if any(metrics[change] for change in changes):
        counts["detail"] = FitConfig().detail.iterations
    counts["rims"] = 100  # there is an opening
    assert steps(whole) == [(stage, i) for stage, count in counts.items() for i in range(count)]
    losses = [json.loads(line)["image"] for line in (whole / "log.jsonl").read_text().splitlines()]
    assert np.mean(losses[90:100]) < 0.8 * np.mean(losses[:10]), "the openings stage learns"


def test_exported_scene_renders_without_the_package(whole):
    code = f"""if True:
        import sys
        import mitsuba as mi, numpy as np
        mi.set_variant("llvm_ad_rgb")
        scene = mi.load_file({str(whole / "scene.xml")!r})
        image = np.array(mi.render(scene, spp=16))
        assert image.shape == ({SIZE}, {SIZE}, 4) and np.isfinite(image).all()
        assert 0.05 < image[..., 3].mean() < 0.6, "the object is seen, and the light behind it is not"
        assert image[..., :3].max() > 0.05
        assert "gshell_mi" not in sys.modules
    """
    subprocess.run([sys.executable, "-c", code], check=True, cwd=whole)


def test_known_light_is_left_alone(bowl_scene, tmp_path):
    assert fit(bowl_scene, tmp_path / "out", *CLOSED, "--known-light", "--iterations", "2") == 0
    light = np.array(mi.Bitmap(str(tmp_path / "out" / "light.exr")))
    np.testing.assert_allclose(light, 1, rtol=1e-3)


def test_without_alpha(bowl_scene, tmp_path, capfd):
    shutil.copytree(bowl_scene.parent, tmp_path / "in")
    scene = tmp_path / "in" / bowl_scene.name
    for path in scene.with_suffix("").glob("*.exr"):
        pixels = np.array(mi.Bitmap(str(path)))
        mi.Bitmap(np.ascontiguousarray(pixels[..., :3])).write(str(path))
    # No mask holds the template against the black around the object: openings have to be justified.
    options = [*SHORT, "--openings.iterations", "40", "--iterations", "2"]
    assert main([str(scene), "-o", str(tmp_path / "out"), *options]) == 0
    told = " ".join(capfd.readouterr().err.split())
    assert "warning: some targets have no alpha: coverage is taken as 1 and the mask losses are off." in told
    log = map(json.loads, (tmp_path / "out" / "log.jsonl").read_text().splitlines())
    assert all(step["mask"] == 0 for step in log if step["stage"] == "joint")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert any("no alpha" in warning for warning in metrics["warnings"])


def test_camera_inside_the_box(bowl_scene, tmp_path):
    shutil.copytree(bowl_scene.parent, tmp_path / "in")
    scene = tmp_path / "in" / bowl_scene.name
    resolution = '<integer name="resolution" value="20"/>'
    box = resolution + '<transform name="to_world"> <scale value="3.5"/> </transform>'
    scene.write_text(scene.read_text().replace(resolution, box))
    assert fit(scene, tmp_path / "out", *CLOSED, "--iterations", "0") == 0
    assert np.abs(mesh(tmp_path / "out").vertices).max() < 1, "nothing is left around the cameras"


def test_reads_the_reference_only_for_missing_targets(tmp_path, monkeypatch):
    scene = write_scene(tmp_path)
    targets = scene.with_suffix("")
    for name in ("truth.ply", "reference.xml"):
        assert (targets / name).is_file()
    monkeypatch.setattr("gshell_mi.scene.REFERENCE_SPP", 4)
    assert fit(scene, tmp_path / "out", *CLOSED, "--iterations", "0") == 0
    rendered = {path.name: path.read_bytes() for path in targets.glob("*.exr")}
    assert set(rendered) == {f"view_{i:03}.exr" for i in range(VIEWS)}

    # With all targets there, nonsense in its place does no harm.
    (targets / "reference.xml").write_text("no scene at all")
    (targets / "truth.ply").write_text("no mesh at all")
    assert fit(scene, tmp_path / "again", *CLOSED, "--iterations", "0") == 0
    assert rendered == {path.name: path.read_bytes() for path in targets.glob("*.exr")}

    (targets / "view_005.exr").unlink()
    assert fit(scene, tmp_path / "third", *CLOSED, "--iterations", "0") == 2


def test_interrupted_by_the_user(bowl_scene, tmp_path):
    output = tmp_path / "out"
    options = (*CLOSED, "--openings.iterations", "30", "--iterations", "1", "--poses", "keep")
    process = start(bowl_scene, output, "--checkpoint-seconds", "0", *options)
    wait_for_step(process, output, "openings", 5)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "continue with --resume" in told and "Traceback" not in told
    assert not list(output.glob(".*")) and (output / "checkpoint.npz").is_file()
    assert fit(bowl_scene, output, "--resume", *options) == 0
    counts = {"openings": 30, "cavities": 4, "refinement": 2, "joint": 1}
    assert steps(output) == [(stage, i) for stage, count in counts.items() for i in range(count)]


@pytest.mark.slow
def test_killed_and_resumed(bowl_scene, tmp_path):
    """Killed once in each stage, the fit takes the steps that it would have taken, bit by bit.

    On one thread, as sums over several depend on their order, and fits diverge tenfold with every step.
    """
    kills = {
        "openings": 30,
        "cavities": 5,
        "refinement": 3,
        "joint": 1,
        "revision": 40,
        "rims": 40,
        "texture": 2,
    }
    options = ("--texture.rounds", "1")
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    finish(start(bowl_scene, whole, *options, program=ONE_THREAD))
    for stage, iteration in kills.items():
        resume = ["--resume"] if killed.exists() else []
        every = ("--checkpoint-seconds", "0.05")
        process = start(bowl_scene, killed, *every, *options, *resume, program=ONE_THREAD)
        wait_for_step(process, killed, stage, iteration)
        process.kill()
        process.communicate()
        assert process.returncode == -signal.SIGKILL
        assert not (killed / "mesh.ply").exists()
    finish(start(bowl_scene, killed, "--resume", *options, program=ONE_THREAD))
    assert steps(killed) == steps(whole), "no step is missing and none is logged twice"
    assert said_of_steps(killed) == said_of_steps(whole)
    assert (killed / "mesh.ply").read_bytes() == (whole / "mesh.ply").read_bytes()


def test_asset_and_report_come_with_a_fit(bowl_scene, tmp_path):
    options = [option for option in SHORT if option != "--no-report"]
    output = tmp_path / "out"
    assert main([str(bowl_scene), "-o", str(output), "--quiet", *options, *CLOSED, "--iterations", "1"]) == 0
    seconds = json.loads((output / "metrics.json").read_text())["seconds"]
    assert seconds["asset"] > 0 and seconds["report"] > 0
    assert seconds["total"] == pytest.approx(sum(seconds.values()) - seconds["total"], abs=0.01)
    assert (output / "mesh.glb").read_bytes()[:4] == b"glTF"
    assert "model-viewer" in (output / "report.html").read_text()


def test_overwriting_keeps_the_earlier_fit_until_the_new_one_is_there(bowl_scene, tmp_path):
    """Interrupted and resumed meanwhile; what no fit wrote stays all along."""
    output, options = tmp_path / "out", (*CLOSED, "--iterations", "1", "--poses", "keep")
    assert fit(bowl_scene, output, *options) == 0
    (output / "views" / "holiday.jpg").write_text("mine")
    before = {path: path.read_bytes() for path in output.rglob("*.*")}
    longer = (*options, "--openings.iterations", "30")
    assert fit(bowl_scene, output, *longer) == 2
    process = start(bowl_scene, output, "--checkpoint-seconds", "0", "--overwrite", *longer)
    wait_for_step(process, output / ".unfinished", "openings", 5)
    assert fit(bowl_scene, output, "--resume", *longer) == 2, "another run is writing there"
    process.kill()
    process.communicate()
    assert {path: path.read_bytes() for path in before} == before
    assert fit(bowl_scene, output, "--resume", *longer) == 0
    counts = {"openings": 30, "cavities": 4, "refinement": 2, "joint": 1}
    assert steps(output) == [(stage, i) for stage, count in counts.items() for i in range(count)]
    assert (output / "views" / "holiday.jpg").read_text() == "mine" and not list(output.glob(".*"))
    assert {path.relative_to(output) for path in output.rglob("*.*")} == {
        path.relative_to(output) for path in before
    }


def test_no_stage_sees_what_is_held_out(bowl_scene, tmp_path, capfd):
    """Targets that show nothing would leave nothing of the hull."""
    shutil.copytree(bowl_scene.parent, tmp_path / "in")
    scene, output = tmp_path / "in" / bowl_scene.name, tmp_path / "out"
    held_out = ["view_000", "view_005", "view_010"]
    for name in held_out:
        path = scene.with_suffix("") / f"{name}.exr"
        mi.Bitmap(np.zeros((SIZE, SIZE, 4), np.float32), mi.Bitmap.PixelFormat.RGBA).write(str(path))
    options = (*CLOSED, "--iterations", "1")
    assert fit(scene, output, *options, "--hold-out", "5") == 0
    metrics = json.loads((output / "metrics.json").read_text())
    scores = metrics["held_out"]
    assert list(scores["views"]) == held_out and len(metrics["training"]["views"]) == VIEWS - 3
    assert metrics["training"]["mean"]["mask_iou"] > 0.7
    assert scores["mean"]["mask_iou"] == 0 and scores["mean"]["psnr_inside"] is None
    last = capfd.readouterr().out.splitlines()[-1]
    assert last.startswith(f"held-out views: {scores['mean']['psnr']:.2f} dB, SSIM") and "IoU 0.000" in last
    # Another fit without any takes their pictures away.
    assert {path.stem for path in (output / "held_out").iterdir()} == set(held_out)
    for name in held_out:
        shutil.copy(bowl_scene.with_suffix("") / f"{name}.exr", scene.with_suffix("") / f"{name}.exr")
    assert fit(scene, output, *options, "--overwrite") == 0
    assert not (output / "held_out").exists()
    assert {path.stem for path in (output / "masks").iterdir()} == {f"view_{i:03}" for i in range(VIEWS)}


def test_a_volume_is_judged(bowl_scene, tmp_path):
    output = tmp_path / "out"
    options = (
        *CLOSED,
        "--iterations",
        "2",
        "--volume.iterations",
        "30",
        "--volume.side",
        "32",
        "--volume.batch",
        "4096",
        "--resolution",
        "20",
        "--checkpoint-seconds",
        "0",
    )
    assert fit(bowl_scene, output, *options) == 0
    metrics = json.loads((output / "metrics.json").read_text())
    found = metrics["volume"]
    assert 0 <= found["taken"] <= found["places"] and len(found["elsewhere"]["gain"]) == 1
    assert metrics["volume_kept"] is ("gain" in found and found["gain"][0] > 2 * found["noise"][0])
    assert [stage for stage, _ in steps(output)].count("volume") == 30
    assert "volume" in metrics["seconds"]
