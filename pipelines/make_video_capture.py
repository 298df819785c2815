"""Films one of our scenes on a patterned table, as people film things, to try ``gshell_mi.capture`` on.

    python pipelines/make_video_capture.py scenes/bunny/reference.xml out/captures/bunny.mp4
    python -m gshell_mi.capture out/captures/bunny.mp4 -o out/captures/scenes/bunny.xml
    python -m gshell_mi.fit out/captures/scenes/bunny.xml -o out/captures/fit

The camera goes once around the object, up and down a little; the video is H.264 with no cameras and no masks.
Beside it, ``bunny.masks/`` gets the true mask of each frame, to measure with.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import imageio_ffmpeg
import mitsuba as mi
import numpy as np
from PIL import Image
from scipy import ndimage

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from scene_builder.cameras import look_at, sensor  # noqa: E402

from gshell_mi.images import srgb  # noqa: E402

FOV = 40.0
#: Degrees that the camera looks down, at its lowest and highest.
ELEVATIONS = (18.0, 48.0)


def pattern(size: int = 1024) -> mi.Bitmap:
    """A table cloth of spots of several sizes and colours, linear RGB."""
    rng = np.random.default_rng(3)
    layers = [
        ndimage.gaussian_filter(rng.standard_normal((size, size, 3)), (s, s, 0), mode="wrap") * s
        for s in (3, 8, 24)
    ]
    return mi.Bitmap((0.35 + 0.25 * np.tanh(2 * sum(layers))).astype(np.float32))


def furnished(reference: Path) -> mi.Scene:
    """The object of a scene on a patterned table, under its own light."""
    stock = mi.load_file(str(reference))
    box = stock.bbox()
    width = float(np.linalg.norm(np.array(box.max) - np.array(box.min)))
    place = mi.ScalarTransform4f().translate([0, float(box.min[1]) - 1e-3, 0]).rotate([1, 0, 0], -90)
    cloth = {"type": "bitmap", "bitmap": pattern(), "raw": True}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 4},
            **{f"object_{k}": shape for k, shape in enumerate(stock.shapes())},
            **{f"light_{k}": light for k, light in enumerate(stock.emitters())},
            "table": {
                "type": "rectangle",
                "to_world": place.scale(1.6 * width),
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": cloth}},
            },
        }
    )


def pose(turn: float, target: np.ndarray, distance: float) -> np.ndarray:
    low, high = np.radians(ELEVATIONS)
    azimuth = 2 * np.pi * turn
    elevation = low + (high - low) * (0.5 - 0.5 * np.cos(3 * azimuth))
    direction = np.array(
        [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    )
    return look_at(target + distance * direction, target)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("reference", type=Path, help="a stock scene: scenes/bunny/reference.xml")
    parser.add_argument("output", type=Path, help="the video")
    parser.add_argument("--frames", type=int, default=96, help="of the video (default 96)")
    parser.add_argument("--size", type=int, default=480, help="pixels per side, even (default 480)")
    parser.add_argument("--spp", type=int, default=32, help="samples per pixel (default 32)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default llvm_ad_rgb)")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    scene, alone = furnished(arguments.reference), mi.load_file(str(arguments.reference))
    box = alone.bbox()
    low, high = np.array(box.min), np.array(box.max)
    target, distance = (low + high) / 2, 1.2 * np.linalg.norm(high - low)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    masks = arguments.output.with_suffix(".masks")
    masks.mkdir(exist_ok=True)
    size = (arguments.size, arguments.size)
    video = imageio_ffmpeg.write_frames(str(arguments.output), size, fps=24, codec="libx264", quality=8)
    video.send(None)
    for index in range(arguments.frames):
        camera = sensor(pose(index / arguments.frames, target, distance), FOV, arguments.size)
        image = np.array(mi.render(scene, sensor=camera, spp=arguments.spp, seed=index))[..., :3]
        video.send((srgb(np.clip(image, 0, 1)) * 255 + 0.5).astype(np.uint8).tobytes())
        alpha = np.array(mi.render(alone, sensor=camera, spp=8, seed=index))[..., 3]
        Image.fromarray((np.clip(alpha, 0, 1) * 255 + 0.5).astype(np.uint8)).save(masks / f"{index:06}.png")
        print(f"\r{index + 1} / {arguments.frames}", end="", file=sys.stderr, flush=True)
    video.close()
    print(file=sys.stderr)


if __name__ == "__main__":
    main()
