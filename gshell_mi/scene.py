"""The fit scene: a Mitsuba XML file with one gshell shape, the training sensors and their targets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np

from .coincident import coincident_meshes
from .compat import write_bitmap
from .errors import UserError
from .files import locked, name_trouble, remove_stale, replacing
from .scene_files import load_scene
from .targets import Target, depth_file, known_file, load_target
from .wording import counted

#: Where no target has more alpha than this, the object would be half transparent.
_FULL = 0.95

#: Samples per pixel of targets rendered from a scene's reference.
REFERENCE_SPP = 128


#: Views that a fit needs at least once some are held out: of a single one nothing is to be learnt in space.
_LEAST_VIEWS = 2


@dataclass(frozen=True)
class View:
    """A sensor and its image."""

    sensor: mi.Sensor
    target: Target


@dataclass(frozen=True)
class FitScene:
    """A loaded fit scene.

    Attributes:
        path: the XML file.
        scene: the Mitsuba scene.
        subject: its gshell shape.
        bsdf: the material that the XML gives the subject.
        light: its emitter ``light`` (``constant`` or ``envmap``).
        sensors: the training views.
        targets: their images, in the same order.
        held_out: views that nothing is fitted to, for scores.
    """

    path: Path
    scene: mi.Scene
    subject: mi.Shape
    bsdf: mi.BSDF
    light: mi.Emitter
    sensors: list[mi.Sensor]
    targets: list[Target]
    held_out: list[View] = field(default_factory=list)

    @property
    def training(self) -> list[View]:
        """The training views."""
        return [View(*pair) for pair in zip(self.sensors, self.targets, strict=True)]

    @property
    def name(self) -> str:
        return self.path.stem

    @property
    def notes(self) -> list[str]:
        """What is hardly meant so, a sentence each; often none."""
        notes = coincident_meshes(self.scene.shapes())
        most = max(float(target.rgba[..., 3].max()) for target in self.targets)
        if most < _FULL:
            notes.append(
                f"No target has an alpha above {most:.2f}, so the object counts as half "
                f"transparent: alpha is coverage; write 1 where the object fills a pixel."
            )
        return notes

    @property
    def target_files(self) -> set[Path]:
        """The files of the targets, and those beside them that say more of them."""
        return {
            file
            for view in (*self.training, *self.held_out)
            for path in [view.target.path]
            for file in (path, depth_file(path), known_file(path))
            if file is not None
        }


def load_fit_scene(
    path: Path,
    targets: Path | None = None,
    *,
    hold_out: int = 0,
    before_targets: Callable[[mi.Shape, list[mi.Sensor]], None] | None = None,
    on_reference: Callable[[int, int], None] | None = None,
) -> FitScene:
    """Loads and checks a fit scene with its targets.

    Args:
        path: the XML file.
        targets: folder of ``<sensor id>.exr``; default: the folder beside the XML with its stem.
        hold_out: every so many-th view, from the first one on, is held out; 0 for none.
        before_targets: called with the gshell shape and the sensors before any target is rendered or read.
        on_reference: called with (views done, views) while missing targets are rendered from
            ``reference.xml``.

    Raises:
        UserError: the file is missing or not a Mitsuba scene, it has not exactly one gshell shape, no
            emitter ``light``, no sensors, sensors of the same id or of one that cannot be a file's name, too
            few views are left, or a target is missing or unusable.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"Scene '{path}' does not exist; give the path of a fit scene's XML file.")
    scene = load_scene(path)
    subject = _the_subject(scene, path)
    light = _the_light(scene, path)
    sensors = scene.sensors()
    if not sensors:
        raise UserError(f"Scene '{path}' has no sensors; add a <sensor id=\"view_000\"> per training view.")
    repeated = [name for name, count in Counter(sensor.id() for sensor in sensors).items() if count > 1]
    if repeated:
        raise UserError(
            f"Scene '{path}' has several sensors with the id '{repeated[0]}'; rename all but one."
        )
    for name in (sensor.id() for sensor in sensors):
        if trouble := name_trouble(name):
            raise UserError(
                f"The id {name[:80]!r} of a sensor of scene '{path}' {trouble}; targets and "
                f'results are files of these names: give it one such as "view_000".'
            )
    held_out = range(0, len(sensors), hold_out) if hold_out else range(0)
    kept = len(sensors) - len(held_out)
    if held_out and kept < _LEAST_VIEWS:
        raise UserError(
            f"--hold-out {hold_out} leaves {kept} of the {counted(len(sensors), 'view')} of "
            f"'{path}', and a fit needs {_LEAST_VIEWS} at least; give a greater number, add "
            f"views, or hold none out."
        )
    if before_targets:
        before_targets(subject, sensors)
    folder = Path(targets) if targets else path.with_suffix("")
    if targets is None:
        render_missing_targets(folder / "reference.xml", folder, sensors, on_reference)
    views = [
        View(sensor, load_target(folder / f"{sensor.id()}.exr", *sensor.film().crop_size()))
        for sensor in sensors
    ]
    training = [view for index, view in enumerate(views) if index not in held_out]
    loaded = [view.target for view in training]
    if not any(target.rgba[..., 3].any() for target in loaded):
        raise UserError(
            f"The targets in '{folder}' show no object: their alpha is 0 everywhere; write coverage into it."
        )
    return FitScene(
        path,
        scene,
        subject,
        subject.bsdf(),
        light,
        [view.sensor for view in training],
        loaded,
        [views[index] for index in held_out],
    )


def _the_subject(scene: mi.Scene, path: Path) -> mi.Shape:
    from .shape import GShell

    found = [shape for shape in scene.shapes() if isinstance(shape, GShell)]
    if len(found) != 1:
        raise UserError(
            f"Scene '{path}' has {len(found) or 'no'} gshell shapes; a fit needs exactly one "
            f'<shape type="gshell" id="subject">.'
        )
    return found[0]


def _the_light(scene: mi.Scene, path: Path) -> mi.Emitter:
    found = [emitter for emitter in scene.emitters() if emitter.id() == "light"]
    # What the fit starts from and exports: an image, or one colour.
    known = len(found) == 1 and not {"data", "radiance.value"}.isdisjoint(mi.traverse(found[0]).keys())
    if not known or not found[0].is_environment():
        raise UserError(
            f"Scene '{path}' has no environment emitter with the id 'light'; add "
            f'<emitter type="constant" id="light"/> or an envmap as the initial lighting.'
        )
    parameters = mi.traverse(found[0])
    for name in ("data", "scale", "radiance.value"):
        if name in parameters and not np.isfinite(np.array(parameters[name])).all():
            raise UserError(
                f"The emitter 'light' of scene '{path}' has a {name} with NaN or infinity; give "
                f"it finite values."
            )
    return found[0]


def render_missing_targets(
    reference: Path,
    folder: Path,
    sensors: list[mi.Sensor],
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Renders the views that have no target in ``folder`` yet, if the scene ``reference`` exists.

    Args:
        reference: the stock scene that holds the true object and light.
        folder: gets ``<sensor id>.exr``.
        sensors: the views.
        progress: called with (views done, views).

    Raises:
        UserError: the reference cannot be loaded, or a target not be written.
    """

    def absent() -> list[mi.Sensor]:
        return [sensor for sensor in sensors if not (folder / f"{sensor.id()}.exr").exists()]

    if not reference.is_file() or not absent():
        return
    with locked(folder, wait=True):  # of two fits of a scene, one renders
        remove_stale(folder)
        _render(reference, folder, absent(), progress)


def _render(
    reference: Path, folder: Path, missing: list[mi.Sensor], progress: Callable[[int, int], None] | None
) -> None:
    scene = load_scene(reference)
    integrator = mi.load_dict({"type": "path", "max_depth": 5, "hide_emitters": True})
    for index, sensor in enumerate(missing):
        if progress:
            progress(index, len(missing))
        image = mi.render(scene, sensor=sensor, integrator=integrator, spp=REFERENCE_SPP, seed=index)
        target = folder / f"{sensor.id()}.exr"
        bitmap = mi.Bitmap(image, mi.Bitmap.PixelFormat.RGBA)
        try:
            # A killed run must not leave half an image behind that the next run takes for a target.
            with replacing(target) as partial:
                write_bitmap(bitmap.convert(component_format=mi.Struct.Type.Float16), partial)
        except OSError as error:
            raise UserError(
                f"Target '{target}' cannot be written ({error.strerror or error}); make the "
                f"folder writable, or name another with --targets."
            ) from error
    if progress:
        progress(len(missing), len(missing))
