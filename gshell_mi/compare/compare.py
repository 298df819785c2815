"""Comparisons of whole sets: folders of images, a fit against its targets, meshes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import mitsuba as mi
import numpy as np

from .. import memory
from ..errors import UserError
from ..evaluation import Scores, albedo_scale, image_scores, mean_scores, mesh_scores, read_image
from ..evaluation.mesh_scores import read_mesh
from ..export.fitted_scene import load_fitted_scene
from ..files import name_trouble
from ..images import over_white, write_png
from ..json_files import read_json_object
from ..light import turned_for
from ..own_folder import TAG, check_own_file
from ..scene_files import load_scene
from ..targets import load_target

Report = Callable[[int, int], None]


def compare_folders(first: Path, second: Path, errors: Path | None = None) -> dict:
    """Scores of two EXR files, or of the files with the same names in two folders.

    Args:
        first: what is judged.
        second: the reference.
        errors: folder for the FLIP maps (magma); of files in it, those of earlier comparisons are replaced.

    Returns:
        ``views`` (scores by name), ``mean`` and ``unmatched``, the names in only one of the folders.

    Raises:
        UserError: a path is missing, the folders share no file, images do not fit together, or another's
            file is in the place of a map.
    """
    pairs, unmatched = _pairs(Path(first), Path(second))
    _check_free(errors, pairs)
    views = {}
    for name, (image, reference) in pairs.items():
        views[name] = _score(name, read_image(image), read_image(reference), errors)
    return {"views": views, "mean": mean_scores(views.values()), "unmatched": unmatched}


def compare_meshes(first: Path, second: Path) -> dict:
    """Scores of the mesh file ``first`` against the reference ``second`` (``evaluation.mesh_scores``)."""
    return {"mesh": mesh_scores(read_mesh(first), read_mesh(second))}


def compare_fit(
    folder: Path,
    *,
    targets: Path | None = None,
    sensors: Path | None = None,
    envmap: Path | None = None,
    mesh: Path | None = None,
    spp: int = 64,
    errors: Path | None = None,
    progress: Report | None = None,
) -> dict:
    """Renders a fit and scores it.

    Args:
        folder: the fit's.
        targets: folder of ``<sensor id>.exr``; default: that which the fit was made from.
        sensors: scene file whose sensors are used, such as those of held-out views; default: the training
            views of ``scene.xml``.
        envmap: light to render under instead of the fitted one; then the scores come raw and after
            ``albedo_scale`` (``mean_albedo_scaled``).
        mesh: the true surface, to score the geometry too.
        spp: samples per pixel.
        errors: folder for the FLIP maps (magma); of files in it, those of earlier comparisons are replaced.
        progress: called with (views done, views).

    Returns:
        ``views`` (scores by sensor), ``mean``, and what ``envmap`` and ``mesh`` add.

    Raises:
        UserError: something is missing or does not fit together.
    """
    folder = Path(folder)
    scene = load_fitted_scene(folder, envmap)
    metrics = _metrics(folder)
    # As a fit scores its own views: each target as it was exposed, and a light that turned where it was then.
    exposed = {} if targets or sensors else _gains(metrics)
    targets = Path(targets) if targets else _recorded_targets(folder, metrics)
    cameras = load_scene(sensors).sensors() if sensors else scene.sensors()
    if not cameras:
        raise UserError(f"'{sensors}' has no sensors; give a scene file with some.")
    _check_free(errors, [camera.id() for camera in cameras])
    width, height = np.max([camera.film().crop_size() for camera in cameras], axis=0)
    memory.require_for_image(int(width), int(height), spp, "A view", "lower --spp")
    references = [
        load_target(targets / f"{camera.id()}.exr", *camera.film().crop_size()) for camera in cameras
    ]
    surfaces = (read_mesh(folder / "mesh.ply"), read_mesh(mesh)) if mesh else None
    integrator = mi.load_dict({"type": "path", "max_depth": 5, "hide_emitters": True})
    images, views = [], {}
    parameters = mi.traverse(scene)
    lights = []
    if metrics.get("light_frame") == "camera" and not envmap:
        to_world = mi.ScalarTransform4f(np.array(parameters["light.to_world"].matrix).reshape(4, 4))
        lights = turned_for(to_world, scene.sensors()[0], cameras)
    for number, (camera, reference) in enumerate(zip(cameras, references, strict=True)):
        if lights:
            parameters["light.to_world"] = lights[number]
            parameters.update()
        image = np.array(mi.render(scene, sensor=camera, integrator=integrator, spp=spp, seed=number))
        if image.shape[2] != 4:
            raise UserError(f"Sensor '{camera.id()}' has a film without alpha; set its pixel_format to rgba.")
        image[..., :3] *= exposed.get(camera.id(), 1)
        if envmap:
            images.append(image)
        views[camera.id()] = _score(camera.id(), image, reference.rgba, errors, np.asarray(reference.known))
        if progress:
            progress(number + 1, len(cameras))
    result = {"views": views, "mean": mean_scores(views.values())}
    if envmap:
        scale = albedo_scale(images, [reference.rgba for reference in references])
        factors = np.append(scale, 1.0)
        scaled = {
            name: image_scores(image * factors, reference.rgba, np.asarray(reference.known))[0]
            for name, image, reference in zip(views, images, references, strict=True)
        }
        result |= {"mean_albedo_scaled": mean_scores(scaled.values()), "albedo_scale": scale.tolist()}
    if surfaces:
        result["mesh"] = mesh_scores(*surfaces)
    return result


def _metrics(folder: Path) -> dict:
    """What a fit has noted; nothing if it has not."""
    try:
        return read_json_object(folder / "metrics.json")
    except (OSError, ValueError):
        return {}


def _gains(metrics: dict) -> dict[str, np.ndarray]:
    """What each view's channels are multiplied by; nothing if all were exposed alike."""
    try:
        gains = metrics["exposures"]["gains"].items()
        return {name: np.array(gain, np.float32).reshape(3) for name, gain in gains}
    except (AttributeError, KeyError, TypeError, ValueError):
        return {}


def _recorded_targets(folder: Path, metrics: dict) -> Path:
    if isinstance(targets := metrics.get("targets"), str):
        return Path(targets)
    raise UserError(
        f"'{folder / 'metrics.json'}' does not tell where the targets are; name their folder with --targets."
    )


def _pairs(first: Path, second: Path) -> tuple[dict[str, tuple[Path, Path]], list[str]]:
    """The files of equal names, whatever the case of their suffix, and those without a partner."""
    for path in (first, second):
        if not path.exists():
            raise UserError(f"'{path}' does not exist; check the path.")
    if first.is_dir() != second.is_dir():
        raise UserError(f"'{first}' and '{second}' are a folder and a file; give two of a kind.")
    if not first.is_dir():
        return {first.stem: (first, second)}, []
    ours, theirs = (
        {path.stem: path for path in sorted(folder.iterdir()) if _is_image(path)}
        for folder in (first, second)
    )
    names = sorted(ours.keys() & theirs.keys())
    if not names:
        raise UserError(f"'{first}' and '{second}' have no EXR files of the same name; rename them in pairs.")
    unmatched = [str((ours | theirs)[name]) for name in sorted(ours.keys() ^ theirs.keys())]
    return {name: (ours[name], theirs[name]) for name in names}, unmatched


def _is_image(path: Path) -> bool:
    """Whether a file is an EXR image, and no map of what is known of one or of its depth."""
    return path.suffix.lower() == ".exr" and Path(path.stem).suffix not in (".known", ".depth")


def _score(
    name: str, image: np.ndarray, reference: np.ndarray, errors: Path | None, known: np.ndarray | None = None
) -> Scores:
    try:
        scores, flip = image_scores(image, reference, known)
    except UserError as error:
        raise UserError(f"'{name}': {error}") from error
    if errors:
        errors.mkdir(parents=True, exist_ok=True)
        write_png(
            errors / f"{name}.png",
            np.concatenate([over_white(reference), over_white(image), flip], 1),
            comment=TAG,
        )
    return scores


def _check_free(errors: Path | None, names: Iterable[str]) -> None:
    """Refuses names that are no files', and files of somebody else where error images would be."""
    for name in names if errors else ():
        if trouble := name_trouble(name, in_scene=False):
            raise UserError(
                f"The name '{name[:80]}' {trouble}, so no error image can have it; rename it or leave out -o."
            )
        check_own_file(Path(errors or ".") / f"{name}.png")
