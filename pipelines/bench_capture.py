"""Times the import of photographs as cameras make them: many, large, JPEG.

    python pipelines/bench_capture.py [--photographs 119] [--width 4160] [--height 3120] [--folder DIR]

Photographs of a textured ball in front of noise, with a mask each and cameras in a transforms.json, are made
in a temporary folder (or in DIR, where a second run finds them) and imported with default settings. Printed
are the seconds of the import and of its parts.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))

#: The ball's radius, the cameras' distance from its centre, and the focal length over the width.
RADIUS, DISTANCE, FOCAL = 1.0, 4.0, 1.1


def make(folder: Path, count: int, width: int, height: int) -> None:
    """Writes the capture; photographs that are there stay."""
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    frames = []
    for k in range(count):
        y = 0.8 * (1 - (2 * k + 1) / count)
        a = k * np.pi * (3 - 5**0.5)
        direction = np.array([np.sqrt(1 - y * y) * np.cos(a), np.sqrt(1 - y * y) * np.sin(a), y])
        right = np.cross([0.0, 0.0, 1.0], direction)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(direction, right), direction, DISTANCE * direction], axis=1)
        frames.append(
            {
                "file_path": f"images/{k:03}.jpg",
                "mask_path": f"masks/{k:03}.png",
                "transform_matrix": pose.tolist(),
            }
        )
    document = {"w": width, "h": height, "fl_x": FOCAL * width, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))

    def photograph(k: int) -> None:
        target = folder / "images" / f"{k:03}.jpg"
        if not target.is_file():
            image, mask = ball(np.array(frames[k]["transform_matrix"]), width, height)
            Image.fromarray(mask).save(folder / "masks" / f"{k:03}.png", compress_level=1)
            Image.fromarray(image).save(target, quality=92)

    with ThreadPoolExecutor() as pool:
        for k, _ in enumerate(pool.map(photograph, range(count))):
            print(f"\rmaking photographs: {k + 1} / {count}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)


def ball(pose: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) photograph and (h, w) mask, uint8, computed at an eighth of the size and enlarged."""
    v, u = np.mgrid[4:height:8, 4:width:8]
    ray = (
        np.stack(
            [(u - width / 2) / (FOCAL * width), -(v - height / 2) / (FOCAL * width), -np.ones(u.shape)],
            axis=-1,
        )
        @ pose[:3, :3].T
    )
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = -ray @ pose[:3, 3]
    room = RADIUS**2 - (DISTANCE**2 - along**2)
    point = pose[:3, 3] + (along - np.sqrt(np.maximum(room, 0)))[..., None] * ray
    hit = room > 0
    color = np.where(hit[..., None], 0.5 + 0.35 * np.sin(7 * point + [0, 1, 2]), 0.3)
    small = (Image.fromarray((values * 255).astype(np.uint8)) for values in (color, hit))
    image, mask = (np.array(item.resize((width, height), Image.Resampling.BICUBIC)) for item in small)
    noise = np.random.default_rng(0).integers(-9, 10, image.shape, dtype=np.int16)
    return np.clip(image + noise, 0, 255).astype(np.uint8), np.where(mask > 127, 255, 0).astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--photographs", type=int, default=119, help="how many (default 119)")
    parser.add_argument("--width", type=int, default=4160, help="pixels (default 4160)")
    parser.add_argument("--height", type=int, default=3120, help="pixels (default 3120)")
    parser.add_argument("--folder", type=Path, help="keep the photographs there")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default llvm_ad_rgb)")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    from gshell_mi.capture import import_capture
    from gshell_mi.capture.check import check_scene

    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary) / "photographs"
        make(folder, arguments.photographs, arguments.width, arguments.height)
        clock = {"start": _now()}

        def progress(done: int, count: int) -> None:
            if done == count:
                clock["targets"] = _now()

        scene = import_capture(folder, Path(temporary) / "scene.xml", progress=progress).path
        clock["box and writing"] = _now()
        check_scene(scene)
        clock["check.png"] = _now()
    for before, name in [*itertools.pairwise(clock), ("start", "box and writing")]:
        seconds, cpu = clock[name] - clock[before]
        label = "whole import" if before == "start" and name != "targets" else name
        print(f"{label:<18} {seconds:6.1f} s, {cpu:6.1f} s of all cores")


def _now() -> np.ndarray:
    """Seconds by the clock and of all cores; on a busy machine the first say little."""
    return np.array([time.perf_counter(), time.process_time()])


if __name__ == "__main__":
    main()
