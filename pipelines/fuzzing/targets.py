"""What is done with damaged inputs. Each target writes good ones once, and then tries a damaged copy."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

from .fits import (
    compare,
    damage_pixels,
    damage_state,
    export,
    film,
    judge_views,
    load_checkpoint,
    report,
    resume,
    write_checkpoint,
    write_fit_to_export,
    write_fit_with_targets,
    write_reported_fit,
    write_started_fit,
    write_views_in_doubt,
)
from .target import Target, command

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "capture"))

_VIEWS = 5


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

    command(main, folder / "source", "-o", folder / "out.xml", "--quiet", "--resolution", "8")


def _imported(write: Callable[[Path], object], *files: str) -> Target:
    """A capture. One that is no longer known as such is taken for mere photographs, whose work is kept."""
    return Target(write, _import, *files, keeps="out.work")


def _ignoring(folder: Path) -> None:
    """A capture with files of masks and ignore masks."""
    from PIL import Image

    _capture("write_colmap", "PINHOLE", False)(folder)
    (folder / "source" / "ignore").mkdir()
    for number, image in enumerate(sorted((folder / "source" / "images").iterdir())):
        ignored = np.zeros((12, 16), np.uint8)
        ignored[:, :number] = 255
        Image.fromarray(ignored).save(folder / "source" / "ignore" / f"{image.stem}.png")


def _video(suffix: str) -> Callable[[Path], object]:
    def write(folder: Path) -> None:
        import imageio_ffmpeg

        codec = "mpeg4" if suffix == "avi" else "libx264"
        writer = imageio_ffmpeg.write_frames(str(folder / f"clip.{suffix}"), (32, 32), fps=8, codec=codec)
        writer.send(None)
        for frame in np.random.default_rng(0).integers(0, 255, (8, 32, 32, 3), np.uint8):
            writer.send(frame.tobytes())
        writer.close()

    return write


def _cut(folder: Path) -> None:
    from gshell_mi.capture.video import cut
    from gshell_mi.capture.workspace import Workspace

    cut(next(folder.glob("clip.*")), Workspace(folder / "out.work"), 3)


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
            header = {
                "compression": OpenEXR.ZIP_COMPRESSION if number < 3 else OpenEXR.PIZ_COMPRESSION,
                "type": OpenEXR.scanlineimage,
            }
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


def _known(folder: Path) -> None:
    """A scene whose targets have depth maps and files of what is known."""
    _scene(folder)
    for number in range(12):
        for kind, value in (("known", 1.0), ("depth", 2.0)):
            bitmap = mi.Bitmap(np.full((8, 8, 1), value, np.float32), mi.Bitmap.PixelFormat.Y)
            bitmap.write(str(folder / "bowl" / f"view_{number:03}.{kind}.exr"))


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


def _map(folder: Path) -> None:
    for kind in ("exr", "hdr", "pfm"):
        mi.Bitmap(np.ones((8, 16, 3), np.float32)).write(str(folder / f"map.{kind}"))


def _light(folder: Path) -> None:
    from gshell_mi.environment_maps import environment_emitter

    for path in sorted(folder.glob("map.*")):
        environment_emitter(path, "Map")


TARGETS = {
    "nerf": _imported(_capture("write_nerf", "nerfstudio"), "*.json"),
    "colmap_text": _imported(_capture("write_colmap", "PINHOLE", False), "*.txt"),
    "colmap_binary": _imported(_capture("write_colmap", "PINHOLE", True), "*.bin"),
    "idr": _imported(_capture("write_idr"), "*.npz"),
    "llff": _imported(_capture("write_llff"), "*.npy"),
    "mitsuba": _imported(_capture("write_mitsuba"), "*.xml", "*.exr"),
    "images": _imported(_images, "*.png", "*.exr", "*.tif", "*.webp"),
    "scene": Target(_scene, _load_scene, "bowl.xml", "*.exr"),
    **{
        f"mesh_{suffix}": Target(_mesh(suffix), _convert, "mesh.*")
        for suffix in ("ply", "obj", "stl", "glb", "off")
    },
    "closed_mesh": Target(_mesh("ply", open_at=9.0), _convert, "mesh.*"),
    "scores": Target(_mesh("ply"), _score, "mesh.*"),
    "masks": _imported(_ignoring, "masks/*.png", "ignore/*.png"),
    "known": Target(_known, _load_scene, "*.known.exr", "*.depth.exr"),
    **{
        f"video_{suffix}": Target(_video(suffix), _cut, "clip.*", keeps="out.work")
        for suffix in ("mp4", "avi", "mkv")
    },
    "turntable": Target(write_fit_with_targets, film, "mesh.ply", "scene.xml", "light.exr"),
    "compare": Target(
        write_fit_with_targets,
        compare,
        "mesh.ply",
        "template.ply",
        "scene.xml",
        "light.exr",
        "view_*.exr",
        keeps="out_errors",
    ),
    "export": Target(write_fit_to_export, export, "mesh.ply", "scene.xml", "light.exr"),
    "report": Target(
        write_reported_fit,
        report,
        "metrics.json",
        "log.jsonl",
        "scene.xml",
        "light.exr",
        "mesh.glb",
        "mesh.ply",
        "view_*.png",
    ),
    "fields": Target(_fields, _extract, "*.npz"),
    "block_fields": Target(_block_fields, _extract, "*.npz"),
    "checkpoint": Target(write_checkpoint, load_checkpoint, "*.npz"),
    "resume": Target(
        write_started_fit,
        resume,
        "out/checkpoint.npz",
        "out/log.jsonl",
        "out/gshell_mi.json",
        keeps="out/",
        damage=damage_state,
    ),
    "views": Target(write_views_in_doubt, judge_views, "view_*.exr", damage=damage_pixels),
    "light": Target(_map, _light, "map.*"),
}
