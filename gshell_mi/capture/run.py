"""From a capture to a fit scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..compat import write_bitmap
from ..environment_maps import read_environment_map
from ..errors import UserError
from ..interrupt import check_interrupt
from ..scene_inputs import scene_inputs
from ..wording import counted
from .acquire import acquire, lacks_masks, make_masks
from .camera import Camera
from .config import AXES, CaptureConfig
from .decoding import FLOAT_SUFFIXES, ColorDecoding, color_profile
from .evidence import assign_ignored
from .formats import mitsuba
from .frames import Capture, Frame
from .masks import Background, assign_masks
from .parallel import in_order
from .prepare import Preparation, exposure_gains
from .region import FLIPPED_AXES, find_box, likely_misreading
from .staging import staged
from .trouble import Thumbnail, find_trouble
from .turned import with_turned_masks
from .white import FULL, ignored_white_of, white_of
from .workspace import Progress
from .writer import clipping_depths, scene_xml, sensors_xml, write_known, write_record, write_target

#: An object farther from the origin than so many of its sizes is moved there.
_FAR = 50.0


@dataclass(frozen=True)
class CaptureResult:
    """What an import wrote.

    Attributes:
        path: the fit scene.
        training, held_out: numbers of views.
        box: (2, 3) corners of the lattice's cube, in the scene.
        warnings: what is likely wrong, a sentence each.
        made: what was made because it was not there: "cameras", "masks".
    """

    path: Path
    training: int
    held_out: int
    box: np.ndarray
    warnings: tuple[str, ...]
    made: tuple[str, ...] = ()


def import_capture(
    source: str | Path,
    output: str | Path,
    *,
    config: CaptureConfig | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    steps: Progress | None = None,
) -> CaptureResult:
    """Turns photographs into a fit scene; cameras and masks that they lack are made.

    A Mitsuba ``llvm`` or ``cuda`` variant must be set. Writes ``output`` (an XML file) and beside it the
    folder of its stem: targets ``view_000.exr`` and so on, ``sensors.xml``, ``capture.json`` (which view is
    which photograph, how the world was moved) and, if there are held-out views, ``test.xml`` with
    ``test/test_000.exr`` and so on. Either all of that or, on an error, nothing. Cameras, masks and the
    frames of a video are kept in a folder beside it, whose name ends in ``.work``, from where a second call
    takes them.

    Args:
        source: the capture's folder or main file, a folder of photographs, or a video.
        output: the fit scene to write.
        config: see ``CaptureConfig``.
        overwrite: replace what an earlier import wrote.
        progress: called with (photographs done, photographs).
        steps: called with (what, done, in all) in the steps before, which only captures without cameras or
            masks have.

    Raises:
        UserError: of anything in the capture or the options that the user can mend.
    """
    config = config or CaptureConfig()
    source, output = Path(source), Path(output)
    with staged(output, overwrite=overwrite, source=source) as staging:
        work = _Import(source, output, config, progress, steps)
        staging.check_inputs(work.inputs())
        return work.write(staging.path)


class _Import:
    def __init__(
        self,
        source: Path,
        output: Path,
        config: CaptureConfig,
        progress: Callable[[int, int], None] | None,
        steps: Progress | None,
    ):
        self.config, self.output, self.progress = config, output, progress
        decoding = ColorDecoding(config.color_space, config.transfer)
        background = None
        if config.background is not None and not Path(config.background).is_file():
            background = Background.parse(config.background, config.background_tolerance)

        def told(what: str, done: int, count: int) -> None:
            check_interrupt()
            if steps:
                steps(what, done, count)

        acquired = acquire(source, output, config, told)
        if config.background is None:
            acquired.capture = assign_masks(acquired.capture, config.masks)
            wanted = config.make_masks != "off" and lacks_masks(acquired.capture)
        else:  # comes before all other masks, as a colour or as a photograph
            wanted = background is None
        if wanted:
            make_masks(acquired, config, lambda capture: to_scene(capture, config.up), told)
        capture, self.made = assign_ignored(acquired.capture, config.ignore), tuple(acquired.made)
        if config.hold_out:
            capture = capture.holding_out(config.hold_out)
        if not capture.training:
            raise UserError(f"'{source}' has no training views; all are held out.")
        self.to_scene = to_scene(capture, config.up)
        self.capture = replace(
            capture,
            frames=tuple(
                replace(frame, camera=frame.camera.moved(self.to_scene)) for frame in capture.frames
            ),
        )
        gains = exposure_gains(capture, config.exposures, exif=not config.no_exif)
        given = background is None and "masks" not in self.made
        white = white_of(self.capture.frames) if given else 1.0
        self.preparation = Preparation(
            decoding,
            background,
            config.invert_masks,
            config.max_size,
            gains,
            white,
            ignored_white_of(self.capture.frames),
        )
        self.warnings = [*capture.notes, *_profile_warning(capture, config)]
        if white < 1:
            self.warnings.append(
                f"The object's value in the masks is {255 * white:.3g} of 255 "
                f"({white:.2g}); it is taken for white, which is 1, and so are larger ones."
            )
        if given:
            self.capture, turned = with_turned_masks(self.capture, white, config.invert_masks)
            self.warnings += turned
        self.cameras: dict[str, Camera] = {}
        self.tests: dict[str, Camera] = {}
        self.thumbnails: list[Thumbnail] = []
        self.views: list[dict] = []

    def inputs(self) -> set[Path]:
        """The files that are read and could be mistaken for some that are written."""
        files = {
            file for frame in self.capture.frames for file in (frame.image, frame.mask, frame.ignored) if file
        }
        files |= {Path(file) for file in (self.config.light, self.config.background) if file is not None}
        if self.capture.format == mitsuba.NAME and (scene := mitsuba.find(self.capture.source)):
            files |= scene_inputs(scene)
        return files

    def write(self, partial: Path) -> CaptureResult:
        stem = self.output.stem
        folder = partial / stem
        self._write_targets(folder)
        box = self._box()
        self.warnings += find_trouble(self.thumbnails, box, self.to_scene)
        box = self._brought_near(box)
        depth = clipping_depths([*self.cameras.values(), *self.tests.values()], box)
        (folder / "sensors.xml").write_text(sensors_xml(self.cameras, depth), encoding="utf-8")
        if self.tests:
            (folder / "test.xml").write_text(sensors_xml(self.tests, depth), encoding="utf-8")
        document = scene_xml(stem, box, self.config.resolution, self._copy_light(folder))
        (partial / self.output.name).write_text(document, encoding="utf-8")
        write_record(folder, self._record(box))
        return CaptureResult(
            self.output, len(self.cameras), len(self.tests), box, tuple(self.warnings), self.made
        )

    def _write_targets(self, folder: Path) -> None:
        empty, faint, most, frames = [], {}, 0.0, self.capture.frames
        # Mitsuba's reader of floating point files has threads of its own.
        threads = 1 if any(frame.image.suffix.lower() in FLOAT_SUFFIXES for frame in frames) else None
        targets = in_order(self.preparation.target, frames, threads=threads)
        for index, (frame, target) in enumerate(zip(frames, targets, strict=True)):
            check_interrupt()
            most = max(most, target.covered)
            if not frame.held_out and not (target.rgba[..., 3] >= 0.5).any():
                empty.append(frame.image.name)  # it would carve away everything that it frames
                continue
            if target.covered < FULL:
                faint[frame.image.name] = target.covered
            name = f"test_{len(self.tests):03}" if frame.held_out else f"view_{len(self.cameras):03}"
            place = folder / "test" if frame.held_out else folder
            place.mkdir(exist_ok=True)
            write_target(place / f"{name}.exr", target.rgba)
            if target.known is not None:
                write_known(place / f"{name}.exr", target.known)
            if frame.held_out:
                self.tests[name] = target.camera
            else:
                self.cameras[name] = target.camera
                self.thumbnails.append(
                    Thumbnail.of(
                        f"{name} ({frame.image.name})",
                        target.rgba,
                        target.camera,
                        target.clipped,
                        target.known,
                    )
                )
            self.views.append(self._view_record(name, frame, target.clipped))
            if self.progress:
                self.progress(index + 1, len(self.capture.frames))
        if not self.cameras:
            raise UserError(
                f"The masks of all images of '{self.capture.source}' are empty (their largest "
                f"coverage is {most:.2g}); masks are white, and alpha is 1, on the object."
            )
        if empty:
            some = ", ".join(empty[:3]) + (" ..." if len(empty) > 3 else "")
            what = "view with an empty mask is" if len(empty) == 1 else "views with empty masks are"
            self.warnings.append(f"{len(empty)} {what} left out: {some}.")
        if faint:
            some = ", ".join(f"{name} ({share:.2f})" for name, share in list(faint.items())[:3])
            self.warnings.append(
                f"{counted(len(faint), 'mask')} nowhere "
                f"{'reaches' if len(faint) == 1 else 'reach'} full coverage; the largest is "
                f"{some}{' ...' if len(faint) > 3 else ''}: the object counts as half "
                f"transparent; write masks that are white (255, 1.0) on the object."
            )

    def _box(self) -> np.ndarray:
        if self.config.box is not None:
            return _cube(np.array(self.config.box).reshape(2, 3))
        # What is thin, such as a leaf seen edge-on, may be gone from a thumbnail.
        silhouettes = [s for s in (thumbnail.silhouette for thumbnail in self.thumbnails) if not s.is_empty]
        region = self.capture.region
        if region is not None:
            turned = self.to_scene[:3, :3] @ region.mean(axis=0)
            region = _cube(region) - region.mean(axis=0) + turned
        box = find_box(silhouettes, region)
        if box is None and region is not None:  # such as a unit sphere that nobody has fitted to the object
            box = find_box(silhouettes)
        if box is None:
            misreading = likely_misreading(silhouettes, self.to_scene)
            cure = "check the masks and cameras, or give --box and look at the picture of --check"
            if misreading:
                cure = f"the cameras look misread, as the masks agree if {misreading}: export them again"
                if misreading == FLIPPED_AXES and self.capture.has_opengl_axes:
                    cure += f", or {'leave out' if self.config.opencv_axes else 'give'} --opencv-axes"
            raise UserError(f"The masks of '{self.capture.source}' have no common volume; {cure}.")
        return box

    def _brought_near(self, box: np.ndarray) -> np.ndarray:
        """Moves the world so that a box very far away comes to the origin; returns the box there."""
        center, half = box.mean(axis=0), np.ptp(box, axis=0).max() / 2
        told = self.config.box is not None or self.config.up == "keep"
        if told or np.linalg.norm(center) < _FAR * half:
            return box
        # Geographic coordinates, say: single precision would leave little of the object.
        shift = np.eye(4)
        shift[:3, 3] = -center
        self.to_scene = shift @ self.to_scene
        self.cameras = {name: camera.moved(shift) for name, camera in self.cameras.items()}
        self.tests = {name: camera.moved(shift) for name, camera in self.tests.items()}
        return box - center

    def _copy_light(self, folder: Path) -> str | None:
        """The name of the copy, relative to the XML file."""
        if self.config.light is None:
            return None
        radiance = read_environment_map(self.config.light, "--light")
        # Whatever the given one's kind, layers and windows are, Mitsuba reads this one.
        write_bitmap(mi.Bitmap(radiance), folder / "light.exr")
        return f"{self.output.stem}/light.exr"

    def _view_record(self, name: str, frame: Frame, clipped: float) -> dict:
        record = {"id": name, "image": str(frame.image), "clipped": round(clipped, 4)}
        if self.preparation.gains:
            record["exposure_stops"] = round(-float(np.log2(self.preparation.gains[frame.image])), 4)
        return record

    def _record(self, box: np.ndarray) -> dict:
        options = {
            name: str(value) if isinstance(value, Path) else value
            for name, value in dataclasses.asdict(self.config).items()
            if value is not None
        }
        return {
            "format": self.capture.format,
            "source": str(self.capture.source),
            "capture_to_scene": self.to_scene.tolist(),
            "box": box.tolist(),
            "options": options,
            "warnings": self.warnings,
            "views": self.views,
        }


def _cube(box: np.ndarray) -> np.ndarray:
    """The cube about the centre of a box (2, 3) that holds it."""
    half = np.ptp(box, axis=0).max() / 2
    return np.stack([box.mean(axis=0) - half, box.mean(axis=0) + half])


def _profile_warning(capture: Capture, config: CaptureConfig) -> list[str]:
    """If the photographs say that they are not sRGB, and nobody else has said anything."""
    if (config.color_space, config.transfer) != ("sRGB", None):
        return []
    profile = color_profile(capture.training[0].image)
    if profile is None or "srgb" in profile.lower():
        return []
    return [
        f"The photographs carry the colour profile '{profile}', but are read as sRGB: name their colour "
        f"space with --color-space."
    ]


def to_scene(capture: Capture, up: str) -> np.ndarray:
    """(4, 4) rotation, by the smallest angle, that turns the capture's up to the scene's, +y.

    Args:
        up: see ``CaptureConfig.up``.
    """
    if up == "keep":
        return np.eye(4)
    direction = np.array(AXES[up]) if up in AXES else capture.up if up == "auto" else None
    if direction is None:
        direction = np.mean([frame.camera.up for frame in capture.frames], axis=0)
        if np.linalg.norm(direction) < 0.2:  # turned every way
            return np.eye(4)
        direction /= np.linalg.norm(direction)
    return _rotation_to_y(direction)


def _rotation_to_y(direction: np.ndarray) -> np.ndarray:
    """The smallest rotation of a unit vector to +y.

    >>> _rotation_to_y(np.array([0.0, 0.0, 1.0]))[:3, :3] @ [1, 2, 3]
    array([ 1.,  3., -2.])
    """
    result = np.eye(4)
    cosine = direction[1]
    if cosine < -1 + 1e-9:
        result[:3, :3] = np.diag([1.0, -1.0, -1.0])
        return result
    axis = np.cross(direction, [0.0, 1.0, 0.0])
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result[:3, :3] = np.eye(3) + skew + skew @ skew / (1 + cosine)
    return result
