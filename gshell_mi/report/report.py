"""Gathers what a fit left behind and fills the page's template with it."""

from __future__ import annotations

import tempfile
import warnings
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import jinja2
import mitsuba as mi
import numpy as np
from markupsafe import Markup

from ..environment_maps import read_environment_map
from ..errors import UserError
from ..export.asset import NO_ATLAS, write_asset
from ..files import replacing
from ..images import BOTH, FIT_ONLY, MASK_ONLY, UNKNOWN, srgb
from ..own_folder import TAG, own_folder
from ..turntable import TurntableConfig, render_turntable, write_video
from ..wording import counted
from .curves import curves
from .data_urls import data_url, image_url
from .metrics import read_metrics
from .viewer_model import viewer_model
from .views import (
    CORRECTION_HEADINGS,
    HEADINGS,
    correction_rows,
    held_out_pictures,
    mask_pictures,
    score_rows,
    training_pictures,
)

_PROBE_HEIGHT = 160

#: Of the overlays, as CSS writes them.
_COLORS = {
    name: "#" + "".join(f"{round(255 * part):02x}" for part in color)
    for name, color in (
        ("both", BOTH),
        ("mask_only", MASK_ONLY),
        ("fit_only", FIT_ONLY),
        ("unknown", UNKNOWN),
    )
}


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
    turntable = TurntableConfig(
        frames=config.turntable_frames,
        size=config.turntable_size,
        spp=config.turntable_spp,
        fps=12,
        max_depth=3,
        orange_back=True,
    )
    frames = render_turntable(folder, turntable)
    if not (folder / "mesh.glb").is_file() and not write_asset(folder)["charts"]:
        warnings.warn(NO_ATLAS, stacklevel=2)
    with tempfile.TemporaryDirectory() as place:
        (video,) = write_video(frames, Path(place) / "turntable.mp4", turntable.fps, gif=False)
        video_data = data_url("video/mp4", video.read_bytes())
    page = files("gshell_mi.report") / "page"
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["counted"] = counted
    template = environment.from_string((page / "report.html.j2").read_text(encoding="utf-8"))
    library = (page / "model-viewer.min.js").read_text(encoding="utf-8").rpartition("//# sourceMappingURL")[0]
    text = template.render(
        name=Path(metrics["scene"]).stem,
        generator=TAG,
        metrics=metrics,
        turntable=video_data,
        model=data_url("model/gltf-binary", viewer_model(folder)),
        library=Markup(library),
        headings=HEADINGS,
        training=training_pictures(folder, config.views, metrics),
        training_rows=score_rows(metrics["training"]),
        held_out=held_out_pictures(folder, metrics),
        held_out_rows=score_rows(metrics["held_out"]) if "held_out" in metrics else [],
        laid_rows=score_rows(metrics["held_out_laid"]) if "held_out_laid" in metrics else [],
        corrections=correction_rows(metrics),
        correction_headings=CORRECTION_HEADINGS,
        masks=mask_pictures(folder, metrics),
        colors=_COLORS,
        curves=[Markup(drawing) for drawing in curves(folder / "log.jsonl")],
        probe=image_url(_probe(folder / "light.exr")),
    )
    with replacing(folder / "report.html") as partial:
        partial.write_text(text, encoding="utf-8")
    return folder / "report.html"


def _probe(path: Path) -> np.ndarray:
    """The light: its map, and a mirror ball and a grey ball in it, exposed alike; 8-bit."""
    radiance = read_environment_map(path, "Light")
    light = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(radiance)})
    size = _PROBE_HEIGHT
    sensor = {
        "type": "perspective",
        "fov": 30,
        "to_world": mi.ScalarTransform4f().look_at([0, 0.6, 4], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba"},
    }
    balls = []
    for bsdf in ({"type": "conductor", "material": "none"}, {"type": "diffuse"}):
        scene = mi.load_dict(
            {
                "type": "scene",
                "light": light,
                "ball": {"type": "sphere", "bsdf": bsdf},
                "sensor": sensor,
                "integrator": {"type": "path", "hide_emitters": True},
            }
        )
        balls.append(np.array(mi.render(scene, spp=64)))
    exposure = 0.8 / max(float(np.percentile(radiance, 95)), 1e-6)
    rows = np.arange(size) * len(radiance) // size
    columns = np.arange(2 * size) * radiance.shape[1] // (2 * size)
    pictures = [srgb(exposure * radiance[rows][:, columns])]
    pictures += [srgb(exposure * ball[..., :3] + 1 - ball[..., 3:]) for ball in balls]
    return (np.concatenate(pictures, axis=1) * 255 + 0.5).astype(np.uint8)
