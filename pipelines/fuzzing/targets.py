"""What is done with damaged inputs. Each target writes good ones once, and then tries a damaged copy."""

from __future__ import annotations

import io
import shutil
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from random import Random

import mitsuba as mi
import numpy as np
import trimesh

from gshell_mi.errors import UserError

from .mutators import damage_file

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "capture"))

_VIEWS = 5


class Broken(Exception):
    """What must not happen has happened, short of a crash."""


class Target:
    """Something that reads files.

    Args:
        write: makes good inputs in a folder.
        attempt: reads them; raises nothing but ``UserError``.
        files: patterns of those that are damaged.
    """

    def __init__(self, write: Callable[[Path], object], attempt: Callable[[Path], object], *files: str):
        self._write, self._attempt, self._files = write, attempt, files

    def prepare(self, folder: Path) -> None:
        """Writes the good inputs, and checks that they are good."""
        folder.mkdir(parents=True)
        self._write(folder)
        self._attempt(self._copy(folder, folder.parent / "good"))

    def try_one(self, folder: Path, seed: str) -> str:
        """Tries a damaged copy of the inputs in ``folder``; "ok" or "refused".

        Raises:
            Exception: whatever should not have happened.
        """
        random = Random(seed)
        place = self._copy(folder, folder.parent / "try")
        candidates = sorted(path for pattern in self._files for path in place.rglob(pattern))
        damaged = random.choice(candidates)
        damage_file(damaged, random)
        before = _tree(place.parent)
        try:
            self._attempt(place)
        except UserError as error:
            if not str(error).strip() or "Traceback" in str(error):
                raise Broken(f"no sentence: {error}") from error
            left = _tree(place.parent) - before
            if left:
                raise Broken(f"left behind after a refusal: {sorted(left)[:3]}") from error
            return "refused"
        outside = {path for path in _tree(place.parent) - before if not path.startswith("try/out")}
        if outside:
            raise Broken(f"written outside of the output: {sorted(outside)[:3]}")
        return "ok"

    @staticmethod
    def _copy(source: Path, goal: Path) -> Path:
        shutil.rmtree(goal, ignore_errors=True)
        shutil.copytree(source, goal)
        return goal


def _tree(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def _command(main: Callable[[list[str]], int], *arguments: object) -> None:
    """Runs a command in this process; ``UserError`` with what it told if it refuses."""
    told = io.StringIO()
    with redirect_stderr(told), redirect_stdout(io.StringIO()):
        code = main([*map(str, arguments)])
    if code == 2:
        raise UserError(told.getvalue())
    if code != 0:
        raise Broken(f"exit code {code}: {told.getvalue()}")


def _cameras() -> list:
    from known_capture import known_cameras

    return known_cameras(_VIEWS, width=16, height=12, fx=20.0, fy=20.0, cx=8.0, cy=6.0)


def _capture(writer: str, *options) -> Callable[[Path], object]:
    def write(folder: Path) -> None:
        import known_capture

        (folder / "source").mkdir()
        getattr(known_capture, writer)(folder / "source", _cameras(), *options)

    return write


def _import(folder: Path) -> None:
    from gshell_mi.capture.__main__ import main

    _command(main, folder / "source", "-o", folder / "out.xml", "--quiet", "--resolution", "8")


def _images(folder: Path) -> None:
    """A capture whose images are of all kinds."""
    import OpenEXR
    import tifffile
    from known_capture import straight_png, write_nerf
    from PIL import Image

    write_nerf(folder / "source", _cameras(), "blender")
    inside = folder / "source" / "train"
    kinds = ("png", "exr", "tif", "exr", "webp")
    for number, (camera, kind) in enumerate(zip(_cameras(), kinds, strict=True)):
        (inside / f"r_{number}.png").unlink()
        rgba, path = camera.render().astype(np.float32), inside / f"r_{number}.{kind}"
        if kind == "exr":
            header = {"compression": OpenEXR.ZIP_COMPRESSION if number < 3 else OpenEXR.PIZ_COMPRESSION,
                      "type": OpenEXR.scanlineimage}
            channels = {name: np.ascontiguousarray(rgba[..., i]) for i, name in enumerate("RGBA")}
            OpenEXR.File(header, channels).write(str(path))
        elif kind == "tif":
            tifffile.imwrite(path, rgba, photometric="rgb", extrasamples=["unassalpha"])
        else:
            Image.fromarray(straight_png(rgba)).save(path)


def _scene(folder: Path) -> None:
    from bowl import write_scene

    scene = write_scene(folder)
    text = scene.read_text(encoding="utf-8")
    for size in ("20", "48"):
        text = text.replace(f'value="{size}"', 'value="8"')
    scene.write_text(text, encoding="utf-8")
    (folder / "bowl" / "reference.xml").unlink()
    for number in range(12):
        bitmap = mi.Bitmap(np.ones((8, 8, 4), np.float32), mi.Bitmap.PixelFormat.RGBA)
        bitmap.write(str(folder / "bowl" / f"view_{number:03}.exr"))


def _load_scene(folder: Path) -> None:
    from gshell_mi.scene import load_fit_scene

    load_fit_scene(folder / "bowl.xml")


def _mesh(suffix: str, *, open_at: float = 0.3) -> Callable[[Path], object]:
    def write(folder: Path) -> None:
        ball = trimesh.creation.icosphere(subdivisions=2, radius=0.6)
        ball = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 1] < open_at])
        ball.export(folder / f"mesh.{suffix}")

    return write


def _convert(folder: Path) -> None:
    from gshell_mi.conversion import from_mesh
    from gshell_mi.lattice import TetLattice

    from_mesh(next(folder.glob("mesh.*")), TetLattice(8))


def _score(folder: Path) -> None:
    from gshell_mi.evaluation.mesh_scores import mesh_scores, read_mesh

    reference = trimesh.creation.icosphere(subdivisions=2, radius=0.6)
    mesh_scores(read_mesh(next(folder.glob("mesh.*"))), reference, samples=500)


def _fit(folder: Path) -> None:
    from fitted import open_sphere, write_fit

    from gshell_mi.files import replacing

    write_fit(folder, open_sphere(2), views=2, size=8)
    with replacing(folder / "metrics.json") as partial:
        partial.write_text('{"targets": "targets", "scene": "a.xml"}', encoding="utf-8")


def _turntable(folder: Path) -> None:
    from gshell_mi.turntable import TurntableConfig, render_turntable

    for _ in render_turntable(folder, TurntableConfig(frames=1, size=8, spp=1, max_depth=2, denoise=False)):
        pass


def _export(folder: Path) -> None:
    from gshell_mi.export.asset import AssetConfig, write_asset

    (folder / "out").mkdir()
    for name in ("mesh.ply", "scene.xml", "light.exr"):
        shutil.copy(folder / name, folder / "out")
    try:
        write_asset(folder / "out", AssetConfig(texture_size=16, unwrap_seconds=5))
    except UserError:
        shutil.rmtree(folder / "out")    # the copy is the test's
        raise


def _fields(folder: Path) -> None:
    from gshell_mi.fields import sphere
    from gshell_mi.lattice import TetLattice

    sphere(TetLattice(6), in_blocks=False).save(folder / "fields.npz")


def _block_fields(folder: Path) -> None:
    from gshell_mi.fields import sphere
    from gshell_mi.lattice import TetLattice

    sphere(TetLattice(16), in_blocks=True).save(folder / "fields.npz")


def _extract(folder: Path) -> None:
    from gshell_mi.fields import LatticeFields

    fields = LatticeFields.load(folder / "fields.npz")
    assert fields.lattice.vertex_count == fields.sdf.size


def _checkpoint(folder: Path) -> None:
    from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint

    Checkpoint(stage="joint", iteration=3, config={}, seconds={}, arrays={"a": np.ones(4, np.float32)}).save(
        folder / "checkpoint.npz")


def _resume(folder: Path) -> None:
    from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint

    Checkpoint.load(folder / "checkpoint.npz")


def _map(folder: Path) -> None:
    mi.Bitmap(np.ones((8, 16, 3), np.float32)).write(str(folder / "map.exr"))
    mi.Bitmap(np.ones((8, 16, 3), np.float32)).write(str(folder / "map.hdr"))


def _light(folder: Path) -> None:
    from gshell_mi.environment_maps import environment_emitter

    for path in sorted(folder.glob("map.*")):
        environment_emitter(path, "Map")


TARGETS = {
    "nerf": Target(_capture("write_nerf", "nerfstudio"), _import, "*.json"),
    "colmap_text": Target(_capture("write_colmap", "PINHOLE", False), _import, "*.txt"),
    "colmap_binary": Target(_capture("write_colmap", "PINHOLE", True), _import, "*.bin"),
    "idr": Target(_capture("write_idr"), _import, "*.npz"),
    "llff": Target(_capture("write_llff"), _import, "*.npy"),
    "mitsuba": Target(_capture("write_mitsuba"), _import, "*.xml", "*.exr"),
    "images": Target(_images, _import, "*.png", "*.exr", "*.tif", "*.webp"),
    "scene": Target(_scene, _load_scene, "bowl.xml", "*.exr"),
    **{f"mesh_{suffix}": Target(_mesh(suffix), _convert, "mesh.*")
       for suffix in ("ply", "obj", "stl", "glb", "off")},
    "closed_mesh": Target(_mesh("ply", open_at=9.0), _convert, "mesh.*"),
    "scores": Target(_mesh("ply"), _score, "mesh.*"),
    "turntable": Target(_fit, _turntable, "mesh.ply", "scene.xml", "light.exr"),
    "export": Target(_fit, _export, "mesh.ply", "scene.xml"),
    "fields": Target(_fields, _extract, "*.npz"),
    "block_fields": Target(_block_fields, _extract, "*.npz"),
    "checkpoint": Target(_checkpoint, _resume, "*.npz"),
    "light": Target(_map, _light, "map.*"),
}
