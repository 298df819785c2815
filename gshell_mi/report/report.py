"""Gathers what a fit left behind and fills the page's template with it."""

from __future__ import annotations

import base64
import io
import tempfile
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import jinja2
import mitsuba as mi
import numpy as np
from markupsafe import Markup
from PIL import Image

from ..environment_maps import read_environment_map
from ..errors import UserError
from ..export.asset import write_asset
from ..files import replacing
from ..images import srgb
from ..integer_images import open_image
from ..own_folder import TAG, own_folder
from ..turntable import TurntableConfig, render_turntable, write_video
from ..wording import counted
from .curves import curves
from .metrics import read_metrics
from .viewer_model import viewer_model

_PROBE_HEIGHT = 160


@dataclass(frozen=True)
class ReportConfig:
    """Settings of ``write_report``."""

    turntable_frames: int = 30
    """Pictures of the turntable."""
    turntable_size: int = 320
    """Its width and height in pixels; even."""
    turntable_spp: int = 16
    """Its samples per pixel."""
    views: int = 8
    """Views that are shown, spread evenly over the training views."""

    def __post_init__(self) -> None:
        if self.views < 1:
            raise UserError(f"--views must be at least 1, not {self.views}.")


def write_report(folder: Path, config: ReportConfig | None = None) -> Path:
    """Writes ``report.html`` of the fit in ``folder``; makes ``mesh.glb`` first if it is missing.

    Raises:
        UserError: the folder holds no finished fit, its mesh is empty, or a file is in the way that no run of
            ours wrote.
    """
    folder = Path(folder)
    metrics = read_metrics(folder / "metrics.json")
    with own_folder(folder, "fit") as own:
        own.claim("report.html")
        return _write(folder, metrics, config or ReportConfig())


def _write(folder: Path, metrics: dict, config: ReportConfig) -> Path:
    turntable = TurntableConfig(frames=config.turntable_frames, size=config.turntable_size,
                                spp=config.turntable_spp, fps=12, max_depth=3, orange_back=True)
    frames = render_turntable(folder, turntable)
    if not (folder / "mesh.glb").is_file():
        write_asset(folder)
    with tempfile.TemporaryDirectory() as place:
        (video,) = write_video(frames, Path(place) / "turntable.mp4", turntable.fps, gif=False)
        video_data = _data_url("video/mp4", video.read_bytes())
    page = files("gshell_mi.report") / "page"
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
                                     lstrip_blocks=True)
    environment.filters["counted"] = counted
    template = environment.from_string((page / "report.html.j2").read_text(encoding="utf-8"))
    library = (page / "model-viewer.min.js").read_text(encoding="utf-8").rpartition("//# sourceMappingURL")[0]
    text = template.render(
        name=Path(metrics["scene"]).stem, generator=TAG, metrics=metrics, turntable=video_data,
        model=_data_url("model/gltf-binary", viewer_model(folder)), library=Markup(library),
        triptychs=_triptychs(folder / "views", config.views, metrics),
        curves=[Markup(drawing) for drawing in curves(folder / "log.jsonl")],
        probe=_image_url(_probe(folder / "light.exr")))
    with replacing(folder / "report.html") as partial:
        partial.write_text(text, encoding="utf-8")
    return folder / "report.html"


def _triptychs(folder: Path, count: int, metrics: dict) -> list[dict]:
    """Target, fit and error of up to ``count`` views, as data URLs."""
    paths = sorted(folder.glob("*.png"))
    chosen = np.unique(np.linspace(0, len(paths) - 1, count).round().astype(int)) if paths else []
    shown = []
    for path in (paths[i] for i in chosen):
        try:
            pixels = np.asarray(open_image(path).convert("RGB"))
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise UserError(f"'{path}' cannot be read as an image; remove it, or run the fit "
                            f"again.") from error
        width = pixels.shape[1] // 3
        target, fit, error = (_image_url(pixels[:, i * width:(i + 1) * width]) for i in range(3))
        shown.append({"name": path.stem, "target": target, "fit": fit, "error": error,
                      "psnr": metrics["psnr_per_view"].get(path.stem)})
    return shown


def _probe(path: Path) -> np.ndarray:
    """The light: its map, and a mirror ball and a grey ball in it, exposed alike; 8-bit."""
    radiance = read_environment_map(path, "Light")
    light = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(radiance)})
    size = _PROBE_HEIGHT
    sensor = {"type": "perspective", "fov": 30,
              "to_world": mi.ScalarTransform4f().look_at([0, 0.6, 4], [0, 0, 0], [0, 1, 0]),
              "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba"}}
    balls = []
    for bsdf in ({"type": "conductor", "material": "none"}, {"type": "diffuse"}):
        scene = mi.load_dict({"type": "scene", "light": light, "ball": {"type": "sphere", "bsdf": bsdf},
                              "sensor": sensor, "integrator": {"type": "path", "hide_emitters": True}})
        balls.append(np.array(mi.render(scene, spp=64)))
    exposure = 0.8 / max(float(np.percentile(radiance, 95)), 1e-6)
    rows = np.arange(size) * len(radiance) // size
    columns = np.arange(2 * size) * radiance.shape[1] // (2 * size)
    pictures = [srgb(exposure * radiance[rows][:, columns])]
    pictures += [srgb(exposure * ball[..., :3] + 1 - ball[..., 3:]) for ball in balls]
    return (np.concatenate(pictures, axis=1) * 255 + 0.5).astype(np.uint8)


def _image_url(pixels: np.ndarray) -> str:
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "WEBP", quality=90)
    return _data_url("image/webp", stream.getvalue())


def _data_url(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
