"""Photographs without cameras to a capture: COLMAP, through ``pycolmap``, on the CPU."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from ..errors import UserError
from ..files import replacing
from ..images import srgb
from ..integer_images import open_image
from .decoding import FLOAT_SUFFIXES, image_size, images_in, read_pixels
from .formats import colmap
from .frames import Capture, Frame, camera_for_image
from .pairs import pairs_of
from .workspace import Progress, Workspace, fingerprint

#: Longer side, in pixels, of the copies that are compared; and how many features each may have.
_SIZE, _FEATURES = 1600, 4096
#: Photographs beyond this number are compared like a video's: all with all would take hours.
_ALL_PAIRS = 250
_EXIF_FOCAL = ExifTags.Base.FocalLengthIn35mmFilm


def photographs_in(source: Path) -> list[Path]:
    """The photographs of a folder, or of ``images`` in it."""
    return images_in(source) or images_in(source / "images")


def place(
    photographs: list[Path],
    source: Path,
    workspace: Workspace,
    *,
    sequential: bool = False,
    progress: Progress | None = None,
) -> tuple[Capture, Path]:
    """Finds the cameras of photographs.

    Where the photographs show a room that stands still around an object that turns, the room is left out.

    Args:
        photographs: their files; if ``sequential``, in order.
        source: what the user calls them.
        workspace: keeps what COLMAP makes; a second call goes on where the first ended.
        sequential: the photographs are a video's, so that each is compared with its neighbours.
        progress: called with ("features" | "matches" | "cameras", done, in all).

    Returns:
        The photographs and cameras of the largest model, and the model's folder.

    Raises:
        UserError: ``pycolmap`` is missing, or COLMAP finds no cameras.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise UserError(
            f"'{source}' has no cameras, and finding them takes COLMAP: install it with `pip "
            f"install 'gshell_mi[colmap]'`."
        )
    if len(photographs) < 3:
        raise UserError(
            f"'{source}' has only {len(photographs)} photographs; 20 or more are needed, from "
            f"all around the object."
        )
    many = not sequential and len(photographs) > _ALL_PAIRS
    job = {
        "photographs": fingerprint(photographs),
        "sequential": sequential or many,
        "cameras": _cameras(photographs),
        # Neighbours are compared, and to a camera IMG_10 comes after IMG_9.
        "images": [
            _copy_name(index)
            for index in sorted(range(len(photographs)), key=lambda k: _counted(photographs[k].name))
        ],
        "features": _FEATURES,
        "size": max(max(_scaled(image_size(path), _SIZE)) for path in photographs),
    }
    folder = workspace.step("colmap", job)
    if not (folder / "models").is_dir():
        _write_copies(photographs, folder / "images", progress)
        _run_colmap(folder, job, progress)
    capture, model = _largest(folder, photographs, source)
    if many:
        note = (
            f"{len(photographs)} photographs are too many to compare each with each: each is compared with "
            f"those next to it by name, as a film's frames are, so their names should count up."
        )
        capture = replace(capture, notes=(note, *capture.notes))
    return capture, model


def _counted(name: str) -> list[str | int]:
    """A key that sorts the numbers in names as numbers.

    >>> sorted(["IMG_10.jpg", "IMG_9.jpg"], key=_counted)
    ['IMG_9.jpg', 'IMG_10.jpg']
    """
    return [int(part) if number % 2 else part for number, part in enumerate(re.split(r"(\d+)", name))]


def _copy_name(index: int) -> str:
    """Of the copy of a photograph by its number."""
    return f"{index:05}.jpg"


def _cameras(photographs: list[Path]) -> list[dict]:
    """The cameras, as far as size and focal length tell them apart: per camera the copies of its photographs
    and SIMPLE_RADIAL's parameters in pixels of these, None if EXIF does not tell the focal length."""
    groups: dict[tuple, list[str]] = {}
    for index, path in enumerate(photographs):
        groups.setdefault((image_size(path), _focal_35mm(path)), []).append(_copy_name(index))
    cameras = []
    for (size, focal), images in groups.items():
        width, height = _scaled(size, _SIZE)
        known = [focal / 36 * max(width, height), width / 2, height / 2, 0.0] if focal else None
        cameras.append({"images": images, "parameters": known})
    return cameras


def _focal_35mm(path: Path) -> float | None:
    """The focal length that shows as much on 35 mm film, in millimetres; None if EXIF does not tell."""
    if path.suffix.lower() in FLOAT_SUFFIXES:
        return None
    try:
        with open_image(path) as image:
            return float(image.getexif().get_ifd(ExifTags.IFD.Exif)[_EXIF_FOCAL]) or None
    except (KeyError, OSError, SyntaxError, TypeError, ValueError):
        return None


def _write_copies(photographs: list[Path], folder: Path, progress: Progress | None) -> None:
    """JPEG files of one kind and size, with names that COLMAP's lists can hold."""
    folder.mkdir(exist_ok=True)

    def copy(index: int) -> None:
        target = folder / _copy_name(index)
        if not target.is_file():
            with replacing(target) as partial:
                small_copy(photographs[index], _SIZE).save(partial, quality=95)

    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        for index, _ in enumerate(pool.map(copy, range(len(photographs)))):
            if progress:
                progress("photographs", index + 1, len(photographs))


def small_copy(path: Path, size: int) -> Image.Image:
    """An 8-bit sRGB copy, as stored (not turned by EXIF), of at most ``size`` pixels.

    Raises:
        UserError: the file cannot be read.
    """
    if path.suffix.lower() in (".jpg", ".jpeg"):
        try:
            with open_image(path) as image:
                wanted = _scaled(image.size, size)
                image.draft("RGB", wanted)  # decodes no more than is needed
                return image.convert("RGB").resize(wanted, Image.Resampling.BOX)
        except Exception as error:
            raise UserError(f"Image '{path}' cannot be read ({error}); copy or export it again.") from error
    pixels = read_pixels(path)[..., :3]
    if pixels.dtype.kind == "f":
        pixels = (srgb(pixels) * 255 + 0.5).astype(np.uint8)
    elif pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    image = Image.fromarray(pixels)
    return image.resize(_scaled(image.size, size), Image.Resampling.BOX)


def _scaled(size: tuple[int, int], longest: int) -> tuple[int, int]:
    scale = min(longest / max(size), 1.0)
    return max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)


def _run_colmap(folder: Path, job: dict, progress: Progress | None) -> None:
    command = [sys.executable, "-m", "gshell_mi.capture.colmap_worker", str(folder)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    log = folder / "colmap.log"
    with open(log, "wb") as output:
        worker = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, env=environment)
        try:
            while worker.poll() is None:
                time.sleep(0.2)
                if progress:
                    for state in _state(folder, job):
                        progress(*state)
        finally:
            worker.kill()
            worker.wait()
    if worker.returncode != 0:
        raise UserError(
            f"COLMAP ended with code {worker.returncode}; '{log}' says why, and the same command "
            f"goes on where it stopped."
        )


def _state(folder: Path, job: dict) -> Iterator[tuple[str, int, int]]:
    """What has been done so far, as the worker's files tell."""
    images = len(job["images"])
    placed = folder / "mapping.progress"
    if placed.is_file():
        yield "cameras", min(placed.stat().st_size + 2, images), images
        return
    try:
        address = (folder / "features.db").absolute().as_uri() + "?mode=ro"
        with closing(sqlite3.connect(address, uri=True, timeout=0.1)) as base:
            (features,) = base.execute("SELECT COUNT(*) FROM keypoints").fetchone()
            (matches,) = base.execute("SELECT COUNT(*) FROM matches").fetchone()
    except sqlite3.Error:  # not there yet, or being written
        return
    if matches:
        yield "matches", matches, len(pairs_of(job["images"], sequential=job["sequential"]))
    else:
        yield "features", features, images


def _largest(folder: Path, photographs: list[Path], source: Path) -> tuple[Capture, Path]:
    models = [model for model in (folder / "models").iterdir() if colmap.find(model)]
    if not models:
        raise UserError(
            f"COLMAP found no cameras for '{source}': the photographs overlap too little or have "
            f"too little texture; take them in small steps, with something textured under and "
            f"around the object."
        )
    captures = [(colmap.read(model, folder / "images"), model) for model in sorted(models)]
    capture, model = max(captures, key=lambda found: len(found[0].frames))
    frames = []
    for frame in capture.frames:
        original = photographs[int(frame.image.stem)]
        frames.append(Frame(original, camera_for_image(frame.camera, image_size(original), original)))
    notes = _notes(folder, photographs, {frame.image for frame in frames})
    return Capture("photographs", source, tuple(frames), notes=notes), model


def _notes(folder: Path, photographs: list[Path], found: set[Path]) -> tuple[str, ...]:
    notes = []
    missing = [path.name for path in photographs if path not in found]
    if missing:
        some = ", ".join(missing[:3]) + (" ..." if len(missing) > 3 else "")
        notes.append(f"COLMAP placed {len(found)} of {len(photographs)} photographs; {some} are left out.")
    room = json.loads((folder / "room.json").read_text())
    if room["removed"]:
        notes.append(
            f"The room stands still while the object turns ({100 * room['share']:.0f} % of the "
            f"features), so cameras are found from what turns."
        )
    return tuple(notes)
