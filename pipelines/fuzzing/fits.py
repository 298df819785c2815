"""Folders of fits, finished and begun, and what reads them."""

from __future__ import annotations

import json
from pathlib import Path
from random import Random

import mitsuba as mi
import numpy as np

from gshell_mi.errors import UserError

from .mutators import damage_file, damaged_array
from .target import command


def _finished(folder: Path) -> None:
    from fitted import open_sphere, write_fit

    write_fit(folder, open_sphere(2), views=2, size=8)
    (folder / "metrics.json").write_text(
        json.dumps(
            {
                "scene": "a.xml",
                "targets": "targets",
                "psnr_training": 30.0,
                "training": {"views": {"view_000": {"psnr": 30.0}}, "mean": {"psnr": 30.0}},
                "held_out": {"views": {"view_001": {"psnr": 20.0, "mask_iou": 0.9}}, "mean": {"psnr": 20.0}},
                "versions": {},
                "config": {},
                "seconds": {"total": 1.0},
                "warnings": ["one"],
                "counts": {"vertices": 3, "faces": 1, "boundary_loops": 1, "components": 1},
            }
        ),
        encoding="utf-8",
    )


def write_fit_with_targets(folder: Path) -> None:
    """A finished fit and its targets."""
    _finished(folder)
    (folder / "targets").mkdir()
    for number in range(2):
        bitmap = mi.Bitmap(np.ones((8, 8, 4), np.float32), mi.Bitmap.PixelFormat.RGBA)
        bitmap.write(str(folder / "targets" / f"view_{number:03}.exr"))


def write_fit_to_export(folder: Path) -> None:
    """A finished fit in a folder of its own, which is written into."""
    (folder / "out").mkdir()
    _finished(folder / "out")


def write_reported_fit(folder: Path) -> None:
    """A finished fit with all that its report shows."""
    from PIL import Image

    from gshell_mi.export.asset import AssetConfig, write_asset

    (folder / "out" / "views").mkdir(parents=True)
    _finished(folder / "out")
    write_asset(folder / "out", AssetConfig(texture_size=16, unwrap_seconds=5))
    (folder / "out" / "log.jsonl").write_text(
        "".join(
            json.dumps(
                {
                    "stage": stage,
                    "iteration": number,
                    "color": 1.0 / (number + 1),
                    "psnr": 20.0,
                    "seconds": 0.1,
                }
            )
            + "\n"
            for stage in ("ghost", "joint")
            for number in range(3)
        )
    )
    for number in range(2):
        Image.fromarray(np.zeros((8, 24, 3), np.uint8)).save(
            folder / "out" / "views" / f"view_{number:03}.png"
        )
    for name, width in (("held_out", 24), ("masks", 8)):
        (folder / "out" / name).mkdir()
        Image.fromarray(np.zeros((8, width, 3), np.uint8)).save(folder / "out" / name / "view_001.png")


def film(folder: Path) -> None:
    """One frame of a turntable."""
    from gshell_mi.turntable import TurntableConfig, render_turntable

    for _ in render_turntable(folder, TurntableConfig(frames=1, size=8, spp=1, max_depth=2, denoise=False)):
        pass


def compare(folder: Path) -> None:
    """The command, images and mesh."""
    from gshell_mi.compare.__main__ import main

    command(
        main,
        folder,
        "--targets",
        folder / "targets",
        "--mesh",
        folder / "template.ply",
        "--spp",
        "1",
        "--json",
        folder / "out.json",
        "-o",
        folder / "out_errors",
    )


def export(folder: Path) -> None:
    """``mesh.glb``."""
    from gshell_mi.export.asset import AssetConfig, write_asset

    write_asset(folder / "out", AssetConfig(texture_size=16, unwrap_seconds=5))


def report(folder: Path) -> None:
    """The command."""
    from gshell_mi.report.__main__ import main

    command(main, folder / "out", "--turntable-frames", "1", "--turntable-size", "16", "--turntable-spp", "1")


def write_checkpoint(folder: Path) -> None:
    """A small checkpoint by itself."""
    from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint

    Checkpoint(stage="joint", iteration=3, config={}, seconds={}, arrays={"a": np.ones(4, np.float32)}).save(
        folder / "checkpoint.npz"
    )


def load_checkpoint(folder: Path) -> None:
    """Only reads it."""
    from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint

    Checkpoint.load(folder / "checkpoint.npz")


class _Stopped(Exception):
    pass


class _Stop:
    """Ends a fit in the middle of its joint stage, as a kill would, after a checkpoint."""

    def begin(self, fit) -> None:
        pass

    def step(self, stage, iteration, count, values, preview) -> None:
        if stage == "joint" and iteration > 0:
            raise _Stopped


def _short() -> list[str]:
    from bowl import CLOSED, SHORT

    return [*SHORT, *CLOSED, "--iterations", "2", "--triptychs", "1", "--checkpoint-seconds", "0"]


def write_started_fit(folder: Path) -> None:
    """A scene, and a fit of it that was stopped after the first step of its joint stage."""
    import tyro
    from bowl import write_fit_scene

    from gshell_mi.fit import fit_scene
    from gshell_mi.fit.config import FitConfig

    scene = write_fit_scene(folder)
    words = [word for word in _short() if word != "--no-report"]
    config = tyro.cli(FitConfig, args=words, config=(tyro.conf.FlagCreatePairsOff,))
    try:
        fit_scene(scene, folder / "out", config=config, report=False, quiet=True, observer=_Stop())
    except _Stopped:
        _find_of_views(folder / "out" / "checkpoint.npz")
        return
    raise AssertionError("the fit has not come to its joint stage")


def _find_of_views(path: Path) -> None:
    """Puts into a checkpoint what stages may have found of its views: gains, pixels to ignore, poses."""
    from bowl import SIZE, VIEWS

    from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint
    from gshell_mi.packed_pixels import packed

    checkpoint = Checkpoint.load(path)
    ignored = np.zeros((SIZE, SIZE), bool)
    ignored[:, :3] = True
    checkpoint.arrays |= {
        "gains": np.full((VIEWS, 3), 1.1, np.float32),
        "ignored": packed([ignored] * VIEWS),
        "poses": np.full((VIEWS, 6), 1e-3),
    }
    checkpoint.save(path)


def write_views_in_doubt(folder: Path) -> None:
    """A scene of few pixels, of some of which nothing is known."""
    from bowl import SIZE, write_fit_scene

    scene = write_fit_scene(folder)
    text = scene.read_text(encoding="utf-8").replace(f'value="{SIZE}"', 'value="12"')
    scene.write_text(text.replace('value="20"', 'value="8"'), encoding="utf-8")
    known = np.ones((12, 12, 1), np.float32)
    known[:, :2] = 0.5
    for path in sorted(scene.with_suffix("").glob("*.exr")):
        small = np.array(mi.Bitmap(str(path))).reshape(12, SIZE // 12, 12, SIZE // 12, 4).mean(axis=(1, 3))
        mi.Bitmap(small.astype(np.float32)).write(str(path))
        mi.Bitmap(known, mi.Bitmap.PixelFormat.Y).write(str(path.with_suffix(".known.exr")))


def judge_views(folder: Path) -> None:
    """The stages that judge views, as a fit runs them, one after another."""
    from silent_steps import Silent

    from gshell_mi.fit.config import FitConfig
    from gshell_mi.fit.stage import Fit
    from gshell_mi.fit.stages.exposures import Exposures
    from gshell_mi.fit.stages.hull import Hull
    from gshell_mi.fit.stages.occlusion import Occlusion
    from gshell_mi.fit.stages.poses import Poses
    from gshell_mi.fit.surface import Surface
    from gshell_mi.scene import load_fit_scene

    config = FitConfig().changed(
        {
            "radiance.batch": 1024,
            "occlusion.most": 0.2,
            "occlusion.levels": 2,
            "cameras.places": 500,
            "gains.places": 100,
        }
    )
    scene = load_fit_scene(folder / "bowl.xml")
    given = Fit.of(scene, config)
    surface = Surface(scene.subject.fields())
    for stage in (
        Occlusion(config.occlusion),
        Hull(config.hull),
        Exposures(config.gains),
        Poses(config.cameras),
    ):
        surface = stage.run(given.corrected(surface), surface, Silent()).after(surface)
    given.corrected(surface)


def damage_pixels(path: Path, random: Random) -> None:
    """Damages a file, or writes another picture that a camera or a mask may have given."""
    if random.random() < 0.1:
        damage_file(path, random)
        return
    pixels = np.array(mi.Bitmap(str(path)))
    pixels = pixels.reshape(*pixels.shape[:2], -1).astype(np.float32)
    alpha, kind = pixels[..., -1:], random.randrange(8)
    if kind == 0:
        pixels[...] = random.choice((0.0, 1.0, 1e-30, 0.5))
    elif kind == 1:
        alpha[...] = random.choice((0.0, 1.0, 0.4999))
    elif kind == 2:
        pixels[..., :-1] *= random.choice((0.0, -1.0, 1e-20, 1e4, 1e30))
    elif kind == 3:
        pixels[random.randrange(len(pixels)), random.randrange(len(pixels))] = random.choice(
            (0.0, 1.0, -1.0, 1e38, np.nan, np.inf)
        )
    elif kind == 4:
        pixels[...] = np.random.default_rng(random.randrange(2**32)).random(pixels.shape)
    elif kind == 5:
        pixels[...] = pixels[::-1].copy()
    elif kind == 6:
        alpha[:, random.randrange(len(pixels)) :] = random.choice((0.0, 1.0))
    else:
        pixels[...] = np.roll(pixels, random.randrange(1, len(pixels)), axis=random.randrange(2))
    kinds = {1: mi.Bitmap.PixelFormat.Y, 4: mi.Bitmap.PixelFormat.RGBA}
    mi.Bitmap(pixels, kinds[pixels.shape[2]]).write(str(path))


def resume(folder: Path) -> None:
    """The command, which has one step left."""
    from gshell_mi.fit.__main__ import main

    command(main, folder / "bowl.xml", "-o", folder / "out", "--resume", "--quiet", *_short())


def damage_state(path: Path, random: Random) -> None:
    """Damages a file, or values in a checkpoint that is a whole one otherwise."""
    from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint

    if path.suffix != ".npz" or random.random() < 0.5:
        damage_file(path, random)
        return
    checkpoint = Checkpoint.load(path)
    with np.errstate(all="ignore"):
        if random.random() < 0.2:
            checkpoint.iteration = random.choice((0, 2, 10**9))
        else:
            name = random.choice(sorted(checkpoint.arrays))
            checkpoint.arrays[name] = damaged_array(checkpoint.arrays[name], random)
    try:
        checkpoint.save(path)
    except (UserError, ValueError):
        path.write_bytes(path.read_bytes()[:-1])
