"""A look before the fit: every view with the box, the axes and the visual hull drawn over it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from ..compat import write_mesh
from ..errors import UserError
from ..extraction import extract
from ..fields.mask_distances import MaskDistances
from ..fields.visual_hull import visual_hull
from ..files import replacing
from ..fit.config import FitConfig
from ..images import srgb
from ..lattice import TetLattice
from ..own_folder import TAG, check_own_file
from ..scene import FitScene, load_fit_scene
from ..views import PinholeViews
from .camera import Camera
from .formats.mitsuba import camera_of
from .region import Silhouette
from .trouble import Thumbnail, find_trouble
from .writer import read_record

#: Pixels of a thumbnail's longer side, and of the two pictures of the cameras.
_THUMB, _OVERVIEW = 240, 560
_HULL_CELLS = 48
_MARGIN = 12
_FONT = 15

_PAPER, _INK, _TROUBLE = (250, 250, 250), (40, 40, 40), (200, 40, 20)
_BOX, _HULL = (255, 150, 0), (255, 0, 200)
_AXES = ((220, 40, 40), (40, 160, 40), (50, 80, 230))
#: Linear, over what a target does not know.
_UNKNOWN = (0.05, 0.15, 0.6)
_FRUSTUM, _FIRST = (90, 110, 140), (200, 40, 20)
#: Pairs of a cube's corners, as bit patterns, that an edge joins.
_EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]


@dataclass(frozen=True)
class CheckReport:
    """What a check found.

    Attributes:
        picture: ``check.png`` in the scene's folder.
        warnings: what is likely wrong, a sentence each.
    """

    picture: Path
    warnings: tuple[str, ...]


def check_scene(scene: str | Path, picture: str | Path | None = None) -> CheckReport:
    """Draws the contact sheet of a fit scene, whoever wrote it, and says what is likely wrong with it.

    A Mitsuba ``llvm`` or ``cuda`` variant must be set. Drawn are, over each view, the lattice's box (orange),
    the world's axes from the box's centre (x red, y green, z blue) and the outline of the visual hull that
    the fit starts with (magenta); and the cameras around the hull from two sides.

    Args:
        scene: the fit scene's XML file.
        picture: the PNG to write; default ``check.png`` in the folder of its targets.

    Raises:
        UserError: the scene cannot be loaded, or the picture not be written, as where a file is in its place
            that no check drew.
    """
    fit_scene = load_fit_scene(Path(scene))
    picture = Path(picture) if picture else Path(scene).with_suffix("") / "check.png"
    check_own_file(picture)
    sheet = _Sheet(fit_scene)
    tag = PngInfo()
    tag.add_text("Software", TAG)
    try:
        with replacing(picture) as partial:
            sheet.draw().save(partial, "PNG", pnginfo=tag)
    except OSError as error:
        raise UserError(
            f"'{picture}' cannot be written ({error.strerror or error}); mend its permissions."
        ) from error
    return CheckReport(picture, tuple(sheet.warnings))


class _Sheet:
    def __init__(self, scene: FitScene):
        self.scene = scene
        to_world = np.array(scene.subject.to_world.matrix, dtype=np.float64).reshape(4, 4)
        signs = np.array([[(corner >> axis & 1) * 2 - 1 for axis in range(3)] for corner in range(8)])
        self.corners = signs @ to_world[:3, :3].T + to_world[:3, 3]
        self.center, self.half = to_world[:3, 3], np.abs(to_world[:3, :3]).sum(axis=1).max()
        views = PinholeViews.from_sensors(scene.sensors)
        self.cameras = [camera_of(sensor, views, i) for i, sensor in enumerate(scene.sensors)]
        record = read_record(scene.path.with_suffix(""))
        self.thumbnails = []
        for sensor, target, camera in zip(scene.sensors, scene.targets, self.cameras, strict=True):
            image, clipped = record.photographs.get(sensor.id(), (None, 0.0))
            name = f"{sensor.id()} ({image.name})" if image else sensor.id()
            self.thumbnails.append(Thumbnail.of(name, target.rgba, camera, clipped, target.known))
        box = np.stack([self.corners.min(axis=0), self.corners.max(axis=0)])
        self.warnings = find_trouble(
            self.thumbnails, box, record.to_scene, has_alpha=all(target.has_alpha for target in scene.targets)
        )
        self.hull = _hull(scene, [thumbnail.silhouette for thumbnail in self.thumbnails])
        if self.hull is None:
            self.warnings.append(
                "The masks have no common volume in the box: a fit of this scene will refuse to start."
            )
        self.font = ImageFont.load_default(_FONT)

    def draw(self) -> Image.Image:
        tiles = [self._view(index) for index in range(len(self.cameras))]
        columns = min(max(6, math.ceil(math.sqrt(len(tiles)))), len(tiles))
        width = max(columns * (_THUMB + _MARGIN), 2 * (_OVERVIEW + _MARGIN)) + _MARGIN
        lines = self._header(width)
        top = _MARGIN + len(lines) * (_FONT + 6) + _MARGIN
        row = _THUMB + _FONT + 2 * _MARGIN
        below = top + _OVERVIEW + 2 * _MARGIN
        sheet = Image.new("RGB", (width, below + row * math.ceil(len(tiles) / columns)), _PAPER)
        pen = ImageDraw.Draw(sheet)
        for index, (line, color) in enumerate(lines):
            pen.text((_MARGIN, _MARGIN + index * (_FONT + 6)), line, fill=color, font=self.font)
        for side, camera in enumerate((self._observer(35, 25), self._observer(0, 89))):
            sheet.paste(self._overview(camera), (_MARGIN + side * (_OVERVIEW + _MARGIN), top))
        for index, tile in enumerate(tiles):
            x = _MARGIN + index % columns * (_THUMB + _MARGIN)
            y = below + index // columns * row
            sheet.paste(tile, (x, y))
            pen.text((x, y + _THUMB + 2), self.thumbnails[index].name, fill=_INK, font=self.font)
        return sheet

    def _header(self, width: int) -> list[tuple[str, tuple[int, int, int]]]:
        low, high = (
            ", ".join(f"{value:.3g}" for value in corner)
            for corner in (self.corners.min(axis=0), self.corners.max(axis=0))
        )
        sizes = {(camera.width, camera.height) for camera in self.cameras}
        about = (
            f"{self.scene.path.name}: {len(self.cameras)} views of "
            f"{' / '.join(f'{w} x {h}' for w, h in sorted(sizes)[:3])} pixels, box ({low}) to ({high})"
        )
        legend = (
            "orange: box   magenta: visual hull   red, green, blue: x, y, z   blue areas: unknown   "
            "red camera: the first"
        )
        warnings = self.warnings or ["No trouble found."]
        lines = [(about, _INK), (legend, _INK)]
        for warning in warnings:
            color = _TROUBLE if self.warnings else _INK
            lines += [(line, color) for line in _wrapped(warning, width - 2 * _MARGIN, self.font)]
        return lines

    # --- one view

    def _view(self, index: int) -> Image.Image:
        """The target on grey, darkened beside the mask, with everything drawn over it."""
        camera, rgba = self.cameras[index], self.scene.targets[index].rgba
        scale = _THUMB / max(camera.width, camera.height)
        size = (max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))
        brightest = max(np.quantile(rgba[..., :3], 0.995), 1e-6)
        exposed = rgba[..., :3] / max(brightest, 1.0) + (1 - rgba[..., 3:]) * 0.15
        known = self.scene.targets[index].known
        assert known is not None, "targets fill it in"
        known = known[..., None]
        exposed = known * exposed + (1 - known) * (0.4 * exposed + 0.6 * np.array(_UNKNOWN))
        image = Image.fromarray((srgb(exposed) * 255).astype(np.uint8)).resize(size, Image.Resampling.BOX)
        camera = camera.resized(*size)
        if self.hull is not None:
            image = _with_outline(image, _normals(self.hull, camera)[1], _HULL)
        pen = ImageDraw.Draw(image)
        for a, b in _EDGES:
            _line(pen, camera, self.corners[a], self.corners[b], _BOX)
        for axis, color in zip(np.eye(3), _AXES, strict=True):
            _line(pen, camera, self.center, self.center + 0.5 * self.half * axis, color, width=2)
        tile = Image.new("RGB", (_THUMB, _THUMB), (225, 225, 225))
        tile.paste(image, ((_THUMB - size[0]) // 2, (_THUMB - size[1]) // 2))
        return tile

    # --- all cameras

    def _observer(self, azimuth: float, elevation: float) -> Camera:
        """A camera outside that sees all others; angles in degrees."""
        points = np.concatenate([self.corners, [camera.center for camera in self.cameras]])
        radius = np.linalg.norm(points - self.center, axis=1).max() * 1.1
        a, e = np.radians([azimuth, elevation])
        towards = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        right = np.cross([0, 1, 0], towards)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        distance = 3.0 * radius
        pose[:3] = np.stack([right, -np.cross(towards, right), -towards, self.center + distance * towards], 1)
        size = 2 * _OVERVIEW  # drawn at twice its size, so that thin lines come out smooth
        focal = size / 2 / math.tan(math.asin(radius / distance))
        return Camera(size, size, focal, focal, size / 2, size / 2, pose)

    def _overview(self, observer: Camera) -> Image.Image:
        shaded = np.full((observer.height, observer.width, 3), 255, np.uint8)
        if self.hull is not None:
            normals, hit = _normals(self.hull, observer)
            grey = 0.35 + 0.6 * np.abs(normals @ -observer.forward)
            shaded[hit] = (grey[hit][:, None] * [240, 200, 235]).astype(np.uint8)
        image = Image.fromarray(shaded)
        pen = ImageDraw.Draw(image)
        for a, b in _EDGES:
            _line(pen, observer, self.corners[a], self.corners[b], _BOX, width=4)
        for axis, color in zip(np.eye(3), _AXES, strict=True):
            _line(pen, observer, self.center, self.center + 1.4 * self.half * axis, color, width=6)
        for index in reversed(range(len(self.cameras))):
            self._frustum(pen, observer, self.cameras[index], _FRUSTUM if index else _FIRST)
        return image.resize((_OVERVIEW, _OVERVIEW), Image.Resampling.BOX)

    def _frustum(
        self, pen: ImageDraw.ImageDraw, observer: Camera, camera: Camera, color: tuple[int, int, int]
    ) -> None:
        """A pyramid as deep as an eighth of its distance to the box, its upper side marked."""
        depth = np.linalg.norm(camera.center - self.center) / 8
        film = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], [0.5, -0.25, 1]])
        corners = camera.center + depth * film @ camera.basis().T
        for index in range(4):
            _line(pen, observer, camera.center, corners[index], color, width=2)
            _line(pen, observer, corners[index], corners[(index + 1) % 4], color, width=2)
        for index in range(2):
            _line(pen, observer, corners[index], corners[4], color, width=2)


def _hull(scene: FitScene, silhouettes: list[Silhouette]) -> mi.Scene | None:
    """The visual hull of the small masks as a scene to trace rays in; None if there is none."""
    seen = [s for s in silhouettes if not s.is_empty]
    if not seen:
        return None
    lattice = TetLattice(_HULL_CELLS)
    points = mi.Transform4f(scene.subject.to_world) @ mi.Point3f(lattice.points(mi.Float))
    views = PinholeViews(
        tuple(map(str, range(len(seen)))),
        np.array([(s.camera.width, s.camera.height) for s in seen]),
        np.array([s.camera.center for s in seen]),
        np.array([s.camera.basis() for s in seen]),
    )
    masks = MaskDistances(views, [s.possible for s in seen])
    distance = visual_hull(points, masks, daylight_votes=FitConfig().hull.daylight_votes)
    sdf = np.clip(
        distance.numpy() / np.abs(np.linalg.det(np.array(scene.subject.to_world.matrix)[:3, :3])) ** (1 / 3),
        -1,
        1,
    )
    if not (sdf < 0).any():
        return None
    surface = extract(lattice, mi.Float(sdf), dr.ones(mi.Float, lattice.vertex_count))
    if surface.is_empty:
        return None
    mesh = mi.Mesh("hull", surface.vertex_count, surface.face_count)
    vertices = mi.Transform4f(scene.subject.to_world) @ mi.Point3f(surface.vertices)
    write_mesh(mesh, dr.ravel(vertices), dr.ravel(mi.Vector3u(surface.faces)))
    return mi.load_dict({"type": "scene", "hull": mesh})


def _normals(hull: mi.Scene, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(height, width, 3) normals of the hull that the pixels see, and (height, width) whether they see it."""
    v, u = np.mgrid[0.5 : camera.height, 0.5 : camera.width]
    film = np.stack([u / camera.width, v / camera.height, np.ones_like(u)], axis=-1).reshape(-1, 3)
    directions = film @ camera.basis().T
    rays = mi.Ray3f(mi.Point3f(camera.center), dr.normalize(mi.Vector3f(directions.T.astype(np.float32))))
    found = hull.ray_intersect(rays)
    shape = (camera.height, camera.width)
    return np.array(found.n).T.reshape(*shape, 3), np.array(found.is_valid()).reshape(shape)


def _with_outline(image: Image.Image, mask: np.ndarray, color: tuple[int, int, int]) -> Image.Image:
    edge = np.zeros_like(mask)
    edge[:-1] |= mask[:-1] != mask[1:]
    edge[:, :-1] |= mask[:, :-1] != mask[:, 1:]
    pixels = np.array(image)
    pixels[edge] = color
    return Image.fromarray(pixels)


def _line(
    pen: ImageDraw.ImageDraw,
    camera: Camera,
    start: np.ndarray,
    end: np.ndarray,
    color: tuple[int, int, int],
    width: int = 1,
) -> None:
    """The image of a segment in the world, cut off shortly before the camera's plane."""
    points = np.stack([start, end])
    depth = (points - camera.center) @ camera.forward
    near = 1e-3 * max(np.abs(depth).max(), 1e-9)
    if depth.max() <= near:
        return
    if depth.min() < near:
        behind = int(depth.argmin())
        t = (depth[1 - behind] - near) / (depth[1 - behind] - depth[behind])
        points[behind] = points[1 - behind] + t * (points[behind] - points[1 - behind])
    ends = camera.project(points)
    if np.abs(ends).max() < 1e5:
        pen.line([tuple(point) for point in ends], fill=color, width=width)


def _wrapped(text: str, width: int, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> list[str]:
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and font.getlength(longer) > width:
            lines.append("    " + word)
        else:
            lines[-1] = longer if lines[-1].strip() else lines[-1] + word
    return lines
