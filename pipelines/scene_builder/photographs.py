"""Writes a capture as people photograph an object, and the truth to score by."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

from gshell_mi.errors import UserError
from gshell_mi.images import srgb
from gshell_mi.scene import render_missing_targets
from gshell_mi.scene_files import load_scene

from . import faults as wrong
from .cameras import TO_Z_UP, look_at, sensor
from .faults import Dice, Faults
from .files import FOV, HALF_EXTENT, fibonacci_sphere, reference_xml, test_xml, whole_view_distance, write_ply
from .finish import finished, load_subject

#: Degrees that the camera's picture spans.
CAMERA_FOV = 40.0
#: Sines of the elevations of the lowest view and the lowest close-up: few people look up from the floor.
_LOWEST, _LOWEST_CLOSE_UP = -0.45, -0.2
#: Distance of a close-up, as a fraction of that of a whole view.
_CLOSE = 0.5
#: Rays per side of a pixel that tell what it shows.
_RAYS = 4


@dataclass(frozen=True)
class Photographs:
    """What to photograph and how."""

    reference: Path
    """A scene's ``reference.xml``, with ``light.exr`` beside it."""
    faults: Faults = dataclasses.field(default_factory=Faults)
    views: int = 60
    size: int = 400
    """Pixels per side."""
    spp: int = 64
    """Samples per pixel."""
    seed: int = 0


@dataclass(frozen=True)
class View:
    """One photograph's camera.

    Attributes:
        pose: camera-to-world, y up.
        close_up: whether it is one.
    """

    pose: np.ndarray
    close_up: bool


def write_photographs(
    what: Photographs, folder: Path, progress: Callable[[int, int], None] | None = None
) -> None:
    """Writes ``capture/`` and ``truth/`` into a new folder, which is there when all of it is.

    ``capture`` is a NeRF-style capture: ``transforms.json`` (camera-to-world, z up), ``images/`` and
    ``masks/``. ``truth`` holds the object in the frame that the import puts it into: ``truth.ply``,
    ``reference.xml``, ``light.exr``, ``test.xml`` with exact linear targets in ``test/``, and
    ``faults.json``: of each photograph the true pose, the exposure in stops and the white balance.

    Raises:
        UserError: the folder is not empty, or the scene cannot be photographed.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"'{folder}' exists already; name a new folder.")
    if what.views < 4 or what.size < 16 or what.spp < 1 or what.seed < 0:
        raise UserError(
            "A capture takes at least 4 views of 16 pixels, 1 sample per pixel and a seed of 0 or more."
        )
    subject = load_subject(what.reference)
    light = Path(what.reference).with_name("light.exr")
    if not light.is_file():
        raise UserError(
            f"'{light}' does not exist; the light of the photographs belongs beside the reference.xml."
        )
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{folder.name}.", dir=folder.parent) as partial:
        truth = Path(partial) / "whole" / "truth"
        truth.mkdir(parents=True)
        dice = Dice(what.seed)
        subject = finished(subject, what.faults, dice)
        shift = (subject.vertices.max(0) + subject.vertices.min(0)) / 2
        vertices = (subject.vertices - shift) * (2 * HALF_EXTENT / subject.extent)
        write_ply(truth / "truth.ply", vertices, subject.faces, subject.color)
        shutil.copyfile(light, truth / "light.exr")
        (truth / "reference.xml").write_text(reference_xml(subject.roughness, subject.metallic))
        (truth / "test.xml").write_text(test_xml(whole_view_distance(vertices, FOV), _LOWEST))
        _write_capture(what, truth.with_name("capture"), truth, vertices, dice, progress)
        sensors = load_scene(truth / "test.xml").sensors()
        (truth / "test").mkdir()
        render_missing_targets(truth / "reference.xml", truth / "test", sensors)
        if folder.exists():
            folder.rmdir()
        truth.parent.rename(folder)


def views_around(vertices: np.ndarray, count: int, close_ups: float, dice: Dice) -> list[View]:
    """Cameras all around, at varying distances, that see the whole object, then close-ups of parts of it."""
    close = round(close_ups * count)
    whole, rng = whole_view_distance(vertices, CAMERA_FOV), dice("places")
    reach = np.linalg.norm(vertices, axis=1).max()
    views = []
    for direction in fibonacci_sphere(count - close, 0.3, _LOWEST):
        # The aim strays by less than the distance leaves room for.
        aim = 0.02 * reach * rng.uniform(-1, 1, 3)
        views.append(View(look_at(whole * rng.uniform(1.05, 1.2) * direction, aim), False))
    for direction in fibonacci_sphere(close, 1.1, _LOWEST_CLOSE_UP):
        aim = 0.6 * vertices[rng.integers(len(vertices))]
        views.append(View(look_at(whole * _CLOSE * rng.uniform(0.95, 1.1) * direction, aim), True))
    return views


def seen(scene: mi.Scene, camera: mi.Sensor, size: int, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Of each pixel the share that shows the object, and that which shows what is lower than ``height``:
    two arrays (size, size)."""
    count = _RAYS * size
    x, y = ((axis.ravel() + 0.5) / count for axis in np.meshgrid(np.arange(count), np.arange(count)))
    ray, _ = camera.sample_ray(0.0, 0.0, mi.Point2f(mi.Float(x), mi.Float(y)), mi.Point2f(0.5))
    hit = scene.ray_intersect_preliminary(ray)
    valid = np.array(hit.is_valid())
    low = valid & (np.array(ray(hit.t).y) < height)

    def share(flags: np.ndarray) -> np.ndarray:
        return flags.reshape(size, _RAYS, size, _RAYS).mean((1, 3))

    return share(valid), share(low)


def _write_capture(
    what: Photographs,
    folder: Path,
    truth: Path,
    vertices: np.ndarray,
    dice: Dice,
    progress: Callable[[int, int], None] | None,
) -> None:
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    faults, scene = what.faults, load_scene(truth / "reference.xml")
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    stand = low + faults.stand / 100 * (high - low)
    suffix = ".jpg" if faults.jpeg else ".png"
    frames, facts = [], []
    views = views_around(vertices, what.views, faults.close_ups, dice)
    for index, view in enumerate(views):
        camera = sensor(view.pose, CAMERA_FOV, what.size)
        rgba = np.array(mi.render(scene, sensor=camera, spp=what.spp, seed=1000 * what.seed + index))
        coverage, lower = seen(scene, camera, what.size, stand)
        linear = rgba[..., :3] + (1 - rgba[..., 3:]) * wrong.wall(coverage.shape, dice("wall", index))
        if faults.stand and wrong.is_level(view.pose):
            linear, coverage = wrong.behind_stand(linear, coverage, lower)
        stops, balance = wrong.exposure(faults.exposure_stops, faults.white_balance, dice("exposure", index))
        encoded = wrong.with_noise(srgb(linear * 2**stops * balance), faults.noise, dice("noise", index))
        mask = wrong.wrong_mask(coverage, faults.mask_pixels, faults.mask_erosion, dice("mask", index))
        pose = wrong.wrong_pose(view.pose, faults.pose_degrees, faults.pose_percent, dice("pose", index))
        image = f"images/{index:03}{suffix}"
        options = {"quality": faults.jpeg, "subsampling": 0} if faults.jpeg else {}
        Image.fromarray(_bytes(encoded)).save(folder / image, **options)
        Image.fromarray(_bytes(mask)).save(folder / "masks" / f"{index:03}.png")
        frames.append(
            {
                "file_path": image,
                "mask_path": f"masks/{index:03}.png",
                "transform_matrix": (TO_Z_UP @ pose).tolist(),
            }
        )
        facts.append(
            {
                "file_path": image,
                "transform_matrix": (TO_Z_UP @ view.pose).tolist(),
                "exposure_stops": stops,
                "white_balance": balance.tolist(),
                "close_up": view.close_up,
            }
        )
        if progress:
            progress(index + 1, len(views))
    focal = what.size / 2 / math.tan(math.radians(CAMERA_FOV) / 2)
    intrinsics = {
        "w": what.size,
        "h": what.size,
        "fl_x": focal,
        "fl_y": focal,
        "cx": what.size / 2,
        "cy": what.size / 2,
    }
    _write_json(folder / "transforms.json", intrinsics | {"frames": frames})
    _write_json(
        truth / "faults.json", {"sizes": dataclasses.asdict(faults), "seed": what.seed, "frames": facts}
    )


def _bytes(values: np.ndarray) -> np.ndarray:
    return (np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8)


def _write_json(path: Path, document: dict) -> None:
    path.write_text(json.dumps(document, indent=1) + "\n")
