"""Photographs one of our scenes as a NeRF-synthetic data set, to try ``gshell_mi.capture`` on.

    python pipelines/make_nerf_capture.py scenes/tshirt/reference.xml out/captures/tshirt [--spp 32]
    python -m gshell_mi.capture out/captures/tshirt -o out/captures/scenes/tshirt.xml
    python -m gshell_mi.fit out/captures/scenes/tshirt.xml -o out/captures/fit

It writes what Mildenhall et al. (NeRF, ECCV 2020) rendered with Blender: ``transforms_train.json`` and
``transforms_test.json`` (one ``camera_angle_x``, camera-to-world matrices with the camera's x right, y up and
z backwards, z up in the world) and 8-bit sRGB PNGs with straight alpha, ``train/r_0.png`` and so on. PNG
holds no more than 1: radiance above that is clipped here, as a real camera clips it.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from scene_builder.cameras import TO_Z_UP, look_at, sensor  # noqa: E402

from gshell_mi.images import srgb  # noqa: E402

FOV = 42.0


def to_png(image: np.ndarray, path: Path) -> None:
    """Linear premultiplied RGBA to 8-bit sRGB with straight alpha."""
    alpha = np.clip(image[..., 3:], 0, 1)
    straight = np.where(alpha > 1e-4, image[..., :3] / np.maximum(alpha, 1e-4), 0)
    rgba = np.concatenate([srgb(straight), alpha], -1)
    Image.fromarray((rgba * 255 + 0.5).astype(np.uint8)).save(path)


def write_split(
    scene: mi.Scene, folder: Path, split: str, poses: list[np.ndarray], size: int, spp: int
) -> None:
    (folder / split).mkdir(parents=True, exist_ok=True)
    frames = []
    for index, pose in enumerate(poses):
        image = mi.render(scene, sensor=sensor(pose, FOV, size), spp=spp, seed=index)
        to_png(np.array(image), folder / split / f"r_{index}.png")
        frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": (TO_Z_UP @ pose).tolist()})
        print(f"\r{split}: {index + 1} / {len(poses)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    document = {"camera_angle_x": float(np.radians(FOV)), "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(document, indent=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("reference", type=Path, help="a stock scene: scenes/tshirt/reference.xml")
    parser.add_argument("output", type=Path, help="folder of the data set")
    parser.add_argument("--views", type=int, default=100, help="training views (default 100)")
    parser.add_argument("--test-views", type=int, default=20, help="held-out views (default 20)")
    parser.add_argument("--size", type=int, default=800, help="pixels per side (default 800)")
    parser.add_argument("--spp", type=int, default=32, help="samples per pixel (default 32)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default llvm_ad_rgb)")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    from scene_builder.files import fibonacci_sphere

    scene = mi.load_file(str(arguments.reference))
    box = scene.bbox()
    radius = np.linalg.norm(np.maximum(np.abs(box.min), np.abs(box.max)))
    distance = 1.04 * radius / np.sin(np.radians(FOV / 2))
    for split, count, turn in (("train", arguments.views, 0.0), ("test", arguments.test_views, 1.0)):
        poses = [look_at(distance * direction, np.zeros(3)) for direction in fibonacci_sphere(count, turn)]
        write_split(scene, arguments.output, split, poses, arguments.size, arguments.spp)


if __name__ == "__main__":
    main()
