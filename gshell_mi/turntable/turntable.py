"""Once around an object, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from .. import memory
from ..errors import UserError
from ..export.fitted_scene import load_fitted_scene
from ..export.ply import read_ply
from ..export.stock_scene import up_axis
from ..images import over_white
from .looks import CHANNELS, Look, Studio, denoiser_available

_FOV = 35.0
_MARGIN = 1.05


@dataclass(frozen=True)
class TurntableConfig:
    """Settings of a turntable."""

    frames: int = 72
    """Pictures of one turn."""
    size: int = 512
    """Width and height in pixels; even."""
    fps: float = 24.0
    """Pictures per second."""
    spp: int = 32
    """Samples per pixel of path-traced pictures."""
    max_depth: int = 5
    """Longest path: 2 is direct light."""
    elevation: float = 25.0
    """Degrees that the camera looks down."""
    channel: str = "shaded"
    """What is shown: shaded, geometry (grey), base_color, roughness, metallic or normal."""
    orange_back: bool = False
    """Paint back faces orange, as the G-Shell paper does."""
    wireframe: bool = False
    """Draw the edges of the triangles."""
    denoise: bool = True
    """Filter path-traced pictures with Open Image Denoise, if it is installed; --no-denoise: do not."""

    def __post_init__(self) -> None:
        for name in ("frames", "size", "spp"):
            if getattr(self, name) < 1:
                raise UserError(f"--{name} must be at least 1, not {getattr(self, name)}.")
        if self.size % 2:
            raise UserError(f"--size must be even for MP4, and is {self.size}.")
        if not 0 < self.fps <= 120:
            raise UserError(f"--fps lies between 0 and 120, unlike {self.fps:g}.")
        if not -89 <= self.elevation <= 89:
            raise UserError(f"--elevation lies between -89 and 89 degrees, unlike {self.elevation:g}.")
        if not 2 <= self.max_depth <= memory.LONGEST_PATH:
            raise UserError(
                f"--max-depth must be at least 2 (direct light) and at most "
                f"{memory.LONGEST_PATH}, not {self.max_depth}."
            )
        if self.channel not in CHANNELS:
            raise UserError(f"--channel '{self.channel}' is unknown; choose one of {', '.join(CHANNELS)}.")


def render_turntable(
    folder: Path, config: TurntableConfig | None = None, *, envmap: Path | None = None
) -> Iterator[np.ndarray]:
    """The frames of a fit's turntable, (size, size, 3) sRGB in [0, 1] in front of white, one at a time.

    The camera circles the axis that is up in the fit's views; the light stays.

    Args:
        folder: the fit's.
        config: settings.
        envmap: light instead of the fitted one.

    Raises:
        UserError: the folder holds no fit, its mesh is empty, the map cannot be read, or there is too little
            memory for a picture.
    """
    config = config or TurntableConfig()
    memory.require_for_image(
        config.size,
        config.size,
        config.spp,
        "A picture of the turntable",
        "lower its size or its samples per pixel",
    )
    scene = load_fitted_scene(Path(folder), envmap)
    mesh_file = Path(folder) / "mesh.ply"
    mesh = read_ply(mesh_file)
    if len(mesh.faces) == 0:
        raise UserError(f"'{mesh_file}' is empty; there is nothing to show.")
    denoise = config.denoise and denoiser_available()
    look = Look(config.channel, config.orange_back, config.wireframe)
    studio = Studio(
        mesh_file, scene.emitters()[0], look, spp=config.spp, max_depth=config.max_depth, denoise=denoise
    )
    cameras = orbit(mesh.vertices, up_axis(scene.sensors()), config.frames, config.elevation, config.size)
    return (over_white(studio.render(camera, seed)) for seed, camera in enumerate(cameras))


def orbit(vertices: np.ndarray, axis: int, count: int, elevation: float, size: int) -> Iterator[mi.Sensor]:
    """Sensors around the bounding box's centre that frame its sphere; ``axis`` as in ``up_axis``."""
    low, high = vertices.min(0), vertices.max(0)
    center, radius = (low + high) / 2, np.linalg.norm(vertices - (low + high) / 2, axis=1).max()
    distance = _MARGIN * radius / np.sin(np.radians(_FOV) / 2)
    up = np.concatenate([np.eye(3), -np.eye(3)])[axis]
    side = np.roll(np.abs(up), 1)
    ahead = np.cross(up, side)
    for turn in np.arange(count) * (2 * np.pi / count):
        level = np.cos(turn) * side + np.sin(turn) * ahead
        toward = np.cos(np.radians(elevation)) * level + np.sin(np.radians(elevation)) * up
        # A box filter, as denoisers expect noise that is independent from pixel to pixel.
        origin = center + distance * toward
        yield mi.load_dict(
            {
                "type": "perspective",
                "fov": _FOV,
                # Mitsuba's own would be 0.01 and 10 000, whatever the object's units.
                "near_clip": 1e-3 * float(distance),
                "far_clip": 1e3 * float(distance),
                "to_world": mi.ScalarTransform4f().look_at(list(origin), list(center), list(up)),
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "pixel_format": "rgba",
                    "rfilter": {"type": "box"},
                },
            }
        )
