"""What the judge of the fit decides, against the truth, and in spoilt images; writes docs/judge.md.

    python pipelines/judge_decisions.py [SCENE.xml ...] [--set resolution=48]

First, each scene is fitted up to its joint stage. Of every change of the whole surface that the judge is
asked about, the true change of the chamfer distance is compared with its verdict. Second, of the openings
that the fit has found, each is proposed once more with other random rays and in images that are spoilt in
several ways, and as many holes are proposed where the truth is closed. What exists in the output folder is
not done again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh
from scipy.spatial import cKDTree

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY / name) for name in ("pipelines", "", "tests")]

from fit_study.command import add_scene_arguments  # noqa: E402
from fit_study.settings import parsed_settings  # noqa: E402
from silent_steps import Silent  # noqa: E402

from gshell_mi.calibration.corrections import Corrections  # noqa: E402
from gshell_mi.doctor import ensure_variant  # noqa: E402
from gshell_mi.evaluation.mesh_scores import mesh_scores  # noqa: E402
from gshell_mi.fit import FitConfig  # noqa: E402
from gshell_mi.fit import stage as fit_stage  # noqa: E402
from gshell_mi.fit.judge import Judge, Verdict, places_of  # noqa: E402
from gshell_mi.fit.pipeline import pipeline  # noqa: E402
from gshell_mi.fit.stage import Fit  # noqa: E402
from gshell_mi.fit.surface import Surface  # noqa: E402
from gshell_mi.fit.template import template_of  # noqa: E402
from gshell_mi.scene import load_fit_scene  # noqa: E402
from gshell_mi.targets import Target  # noqa: E402
from gshell_mi.template.msdf import clean_opacity  # noqa: E402
from gshell_mi.topology import equal_patches, mesh_components, topology  # noqa: E402
from gshell_mi.views import PinholeViews  # noqa: E402

SCENES = [REPOSITORY / "scenes" / f"{name}.xml" for name in ("tshirt", "skirt", "mug", "chair")]

#: Points on either surface of a chamfer distance: two samplings of one surface differ by some 0.001 %.
_POINTS = 100_000

#: Changes of the chamfer distance below this, in per cent, are none.
_SAME = 0.003

#: Size of noise, of pose errors in pixels, and of the texture; its wavelengths, in cells.
_NOISE, _PIXELS, _TEXTURE, _WAVELENGTHS = 0.05, 1.0, 0.5, (1.0, 4.0)

#: Radius of a hole that is not there, as a share of the surface's largest extent, and least distance, in such
#: radii, from an opening.
_HOLE, _APART = 0.08, 2.0

#: Vertices farther than this from the truth, in cells, are caps; holes are proposed where they are nearer.
_NEAR = 1.0

_INTRODUCTION = """\
# What the judge decides

[How a fit works](fit.md) tells by which rule. This page, of `python pipelines/judge_decisions.py`, shows what
comes of it on scenes whose truth is known.

## Changes of the whole surface

Every refinement, hollow, vessel and other start that the judge is asked about in a fit, with default
settings: the *gain* is the mean logarithm of the error before over that after, ± its standard error (of a
change that is judged place by place, that of the best and of the worst); chamfer is the distance from the
truth in per cent of its diagonal, before → after all of the proposal. A change below {same} % is none.

{changes}

In *occlusion* all places together are a hull that fewer masks shape; only those that are accepted are taken,
so a later row starts from what an earlier one has left.

## Openings, true and false, in spoilt images

All openings that the first half of a fit finds are proposed again, and as many round holes where the truth is
closed: with other random rays, with noise of {noise} on every pixel (white is 1), with each camera turned by
{pixels:g} pixel in a random direction, and with a random texture on the object that changes its colour by up
to half, its finest waves as long as a cell. *z* is the gain over its standard error; 2 is
needed, and more where many are asked for.

Noise hides what is dark behind an opening. Judged by pixels alone, 2 of the T-shirt's 4 were missed in it;
the means of blocks tell of them.

{openings}
"""


@dataclass(frozen=True)
class Change:
    """One decision on a whole surface.

    Attributes:
        stage: that proposed it.
        gain, noise, accepted: by place.
        before, after: chamfer distances from the truth, per cent.
    """

    stage: str
    gain: list[float]
    noise: list[float]
    accepted: list[bool]
    before: float
    after: float

    def row(self, scene: str) -> str:
        """A line of the table."""
        places = sorted(zip(self.gain, self.noise, strict=True))
        shown = [places[-1]] if len(places) == 1 else [places[-1], places[0]]
        gains = ", ".join(f"{gain:+.3f} ± {noise:.3f}" for gain, noise in shown)
        said = "accepted" if all(self.accepted) else "rejected"
        if len(places) > 1:
            said = f"{sum(self.accepted)} of {len(places)} accepted"
        better = self.before - self.after
        true = "same" if abs(better) < _SAME else "better" if better > 0 else "worse"
        change = f"{self.before:.3f} → {self.after:.3f}"
        return f"| {scene} | {self.stage} | {gains} | {said} | {change} | {true} |"


def chamfer(vertices: np.ndarray, faces: np.ndarray, truth: trimesh.Trimesh) -> float:
    """Mean of both directions, in per cent of the truth's diagonal."""
    return mesh_scores(trimesh.Trimesh(vertices, faces, process=False), truth, _POINTS)["chamfer"]


def fitted_openings(path: Path, config: FitConfig) -> tuple[list[Change], Surface]:
    """Runs the stages before the joint stage.

    Returns:
        What the judge has decided on whole surfaces, and the surface after the openings stage.
    """
    scene, truth = load_fit_scene(path), trimesh.load(path.with_suffix("") / "truth.ply", process=False)
    fit, changes, surfaces = Fit.of(scene, config), [], {}
    surface, stage = Surface(scene.subject.fields()), None

    class Recording(Judge):
        def compare(self, before, after, label=None, where=None, *, places=None) -> Verdict:
            verdict = super().compare(before, after, label, where, places=places)
            # Parts are openings; one split is the refinement's second opinion.
            if before.values is after.values is None and len(self.splits) > 1 and len(after.shown.mesh[1]):
                changes.append(
                    Change(
                        stage.name,
                        verdict.gain.tolist(),
                        verdict.noise.tolist(),
                        verdict.accepted.tolist(),
                        chamfer(*before.shown.mesh, truth),
                        chamfer(*after.shown.mesh, truth),
                    )
                )
            return verdict

    given, fit_stage.Judge = fit_stage.Judge, Recording
    try:
        for stage in pipeline(scene, fit.lattices, config):
            if stage.name == "joint":
                break
            surface = stage.run(fit.corrected(surface), surface, Silent()).after(surface)
            surfaces[stage.name] = surface
    finally:
        fit_stage.Judge = given
    return changes, surfaces["openings"]


def spoilt(fit: Fit, cell: float) -> Iterator[tuple[str, PinholeViews, list[Target], int]]:
    """Names, cameras, images and seeds to judge with."""
    views, targets = fit.views, fit.scene.targets
    for seed in range(3):
        yield f"seed {seed}", views, targets, seed
    rng = np.random.default_rng(0)

    def changed(change: Callable[[np.ndarray, int], np.ndarray]) -> list[Target]:
        return [
            replace(
                target,
                rgba=np.concatenate([change(target.rgba, view), target.rgba[..., 3:]], axis=-1).astype(
                    np.float32
                ),
            )
            for view, target in enumerate(targets)
        ]

    def noisy(rgba: np.ndarray, _: int) -> np.ndarray:
        noise = rng.normal(0, _NOISE, rgba[..., :3].shape)
        return np.maximum(rgba[..., :3] + noise * (rgba[..., 3:] > 0), 0)

    yield f"noise of {_NOISE}", views, changed(noisy), 0
    angle = np.linalg.norm(views.bases[:, :, 0], axis=1) / views.sizes[:, 0]
    turns = rng.normal(size=(len(views), 3))
    turns *= (_PIXELS * angle / np.linalg.norm(turns, axis=1))[:, None]
    yield f"poses, {_PIXELS:g} pixel", Corrections(turns, 0 * turns).views(views), targets, 0
    scene = mi.load_dict(
        {
            "type": "scene",
            "truth": {"type": "ply", "filename": str(fit.scene.path.with_suffix("") / "truth.ply")},
        }
    )
    waves = rng.normal(size=(64, 3))
    lengths = cell * np.exp(rng.uniform(*np.log(_WAVELENGTHS), len(waves)))
    waves *= (2 * np.pi / (lengths * np.linalg.norm(waves, axis=1)))[:, None]
    phases = rng.uniform(0, 2 * np.pi, len(waves))

    def textured(rgba: np.ndarray, view: int) -> np.ndarray:
        at = scene.ray_intersect_preliminary(views.pixel_rays(view))
        ray = views.pixel_rays(view)
        points = np.nan_to_num((ray.o + np.minimum(at.t.numpy(), 1e6) * ray.d).numpy().T)
        value = np.cos(points @ waves.T + phases).sum(axis=1) / np.sqrt(len(waves) / 2)
        factor = 1 + _TEXTURE * np.clip(value, -1, 1)
        return rgba[..., :3] * factor.reshape(*rgba.shape[:2], 1)

    yield "texture", views, changed(textured), 0


def holes(
    vertices: np.ndarray, faces: np.ndarray, opened: np.ndarray, closed: np.ndarray, count: int
) -> np.ndarray:
    """(V,) which hole that is not there a vertex is in, from 0; -1 if in none.

    Args:
        vertices, faces: of a template.
        opened: (V,) its true openings.
        closed: (V,) where the truth has a surface.
        count: of holes, at most; each as far from the others as can be.
    """
    radius = _HOLE * np.ptp(vertices, axis=0).max()
    away = cKDTree(vertices[opened]).query(vertices)[0] if opened.any() else np.full(len(vertices), np.inf)
    free = closed & (away > _APART * radius)
    away, label = np.where(free, np.minimum(away, 1e9), 0), np.full(len(vertices), -1)
    for hole in range(count):
        centre = int(np.argmax(away))
        if away[centre] <= radius:
            break
        distance = np.linalg.norm(vertices - vertices[centre], axis=1)
        inside = (distance < radius) & free
        patch = equal_patches(inside, faces)
        label[inside & (patch == patch[centre])] = hole
        away = np.minimum(away, np.where(free, distance - radius, 0))
    return label


def decided_openings(path: Path, config: FitConfig, surface: Surface) -> list[dict]:
    """What is said of true openings and of holes that are not there, in each of the spoilt images; nothing if
    the truth is closed."""
    scene, truth = load_fit_scene(path), trimesh.load(path.with_suffix("") / "truth.ply", process=False)
    if topology(np.asarray(truth.vertices), np.asarray(truth.faces)).boundary_loops == 0:
        return []
    fit = Fit.of(scene, config)
    template, cell = template_of(scene.subject, surface), fit.cell(surface)
    mesh = vertices, faces = template.closed
    opened = clean_opacity(template.logits, vertices, faces, config.topology.min_area) <= 0
    piece = mesh_components(faces, len(vertices))
    opened &= (np.bincount(piece, ~opened) > 0)[piece]  # what is all open is no opening in anything
    points, _ = trimesh.sample.sample_surface(truth, 4 * _POINTS, seed=0)
    near = cKDTree(points).query(vertices)[0] < _NEAR * cell
    true = places_of(opened, equal_patches(opened, faces))
    false = holes(vertices, faces, opened, near & ~opened, int(true.max()) + 1)
    rows = []
    for name, views, targets, seed in spoilt(fit, cell):
        judge = Judge(views, targets, Judge.halves(len(views)), batch=config.radiance.batch, seed=seed)
        shown = judge.shown(mesh)
        right = shown.part(np.where(opened, -1.0, 1.0))
        wrong = shown.part(np.where(opened | (false >= 0), -1.0, 1.0))
        said = [judge.compare(shown.whole, right, true), judge.compare(right, wrong, false)]
        rows.append(
            {
                "images": name,
                **{
                    kind: {
                        "z": (verdict.gain / verdict.noise).tolist(),
                        "accepted": verdict.accepted.tolist(),
                    }
                    for kind, verdict in zip(("true", "false"), said, strict=True)
                },
            }
        )
    return rows


def openings_row(scene: str, row: dict) -> str:
    """A line of the table."""
    cells = []
    for kind, extreme, word in (("true", min, "least"), ("false", max, "largest")):
        z, accepted = row[kind]["z"], row[kind]["accepted"]
        cells += [f"{sum(accepted)} of {len(accepted)}", f"{word} {extreme(z):+.1f}"]
    return f"| {scene} | {row['images']} | {' | '.join(cells)} |"


def page(outcomes: dict[str, dict]) -> str:
    """Of what there is of some scenes, by name."""
    changes = ["| scene | stage | gain | the judge | chamfer % | in truth |", "|---" * 6 + "|"]
    openings = ["| scene | images | true openings accepted | z | holes accepted | z |", "|---" * 6 + "|"]
    for scene, outcome in outcomes.items():
        changes += [Change(**change).row(scene) for change in outcome["changes"]]
        openings += [openings_row(scene, row) for row in outcome["openings"]]
    return _INTRODUCTION.format(
        changes="\n".join(changes), openings="\n".join(openings), same=_SAME, noise=_NOISE, pixels=_PIXELS
    )


def main(given: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_scene_arguments(parser, SCENES)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/judge"), help="folder of the outcomes")
    parser.add_argument(
        "--page", type=Path, default=REPOSITORY / "docs" / "judge.md", help="the Markdown file to write"
    )
    arguments = parser.parse_args(given)
    ensure_variant()
    config = parsed_settings(arguments.settings)
    arguments.output.mkdir(parents=True, exist_ok=True)
    outcomes = {}
    for scene in arguments.scenes:
        stored = arguments.output / f"{scene.stem}.json"
        if not stored.exists():
            print(f"{scene.stem} ...", flush=True)
            changes, surface = fitted_openings(scene, config)
            stored.write_text(
                json.dumps(
                    {
                        "changes": [vars(change) for change in changes],
                        "openings": decided_openings(scene, config, surface),
                    },
                    indent=1,
                )
            )
        outcomes[scene.stem] = json.loads(stored.read_text())
        arguments.page.write_text(page(outcomes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
