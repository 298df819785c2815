"""Measures derivatives of ``gshell_path`` against finite differences and writes ``docs/gradients.md``.

    python pipelines/validate_gradients.py [--scenes NAME ...] [--resolution 64] [--seconds 25]

For every scene of ``pipelines/gradient_scenes.py``: the derivative of a weighted sum of the image's colours
and the gradient image, by finite differences of the stock ``path`` integrator
(``pipelines/surface_differences.py``), by ``gshell_path`` in forward and reverse mode, and by Mitsuba's
``prb_projective`` and (at depth 2) ``direct_projective``. Figures after ± are one standard error over
independent repeats. Measurements are kept in ``out/gradients`` and every run adds repeats to them: delete
them after a change of the code. The page shows all that are there, and of other scenes what it showed before.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

sys.path.insert(0, str(Path(__file__).parents[1]))

import gshell_mi  # noqa: F401  (registers the plugins when the variant is set)
from pipelines import gradient_scenes
from pipelines.surface_differences import SurfaceImage

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "out" / "gradients"

PARTS = ("fd", "ours", "stock")

STOCK = ("prb_projective", "direct_projective")

SPP, FEW = 128, 4

#: Points on surfaces for one finite difference
POINTS = 400_000

#: Standard errors that end the repeats: of the figures compared to 1 %, and of those compared to 3 %
FINE, COARSE = 0.003, 0.01


def mean_and_error(values):
    values = np.asarray(values, float)
    return values.mean(), values.std(ddof=1) / np.sqrt(len(values))


def repeat(draw, values, goal, seconds, least=24):
    """Appends ``draw(seed)`` to ``values`` until the standard error is ``goal`` of the mean, or time is up.

    The time is processor time after the first call, which compiles. Fewer than ``least`` values would stop
    too early by chance: where they happen to lie close together.
    """
    start = None
    while True:
        if len(values) >= least:
            mean, error = mean_and_error(values)
            if error <= goal * abs(mean) or (start and time.process_time() - start > seconds):
                return
        values.append(draw(len(values)))
        start = start or time.process_time()


def correlation(a, b):
    """Of two gradient images' colours, after a blur of one pixel that evens out their noise."""
    a, b = (gaussian_filter(x[..., :3], (1, 1, 0)).ravel() for x in (a, b))
    return float(np.corrcoef(a, b)[0, 1])


def red_and_blue(image, scale):
    """Positive values red, negative blue."""
    x = np.clip(image[..., :3].mean(-1) / scale, -1, 1)
    return np.stack([np.where(x > 0, 1, 1 + x), 1 - np.abs(x), np.where(x < 0, 1, 1 - x)], -1)


def measure(case, resolution, seconds, few_error, parts):
    """Measures parts of a row ("fd", "ours", "stock") and keeps them in ``out/gradients``."""
    mover = gradient_scenes.Mover(case, resolution)
    weights = gradient_scenes.image_weights(resolution)
    kept = recall(case, resolution)
    row, images = kept.get("row", {}), kept.get("images", {})

    def total(image):
        return float((image[..., :3].astype(float) * weights).sum())

    def measured(name, draw, goal, seconds, **options):
        """Adds to the values kept under the name, and to their mean image."""
        values = row[name] if isinstance(row.get(name), list) else []
        images[name] = images.get(name, 0) * np.float64(len(values))

        def one(seed):
            image = draw(seed)
            images[name] = images[name] + image
            return total(image)

        repeat(one, values, goal, seconds, **options)
        images[name] /= len(values)
        row[name] = values

    def projected(name):
        options = {"max_depth": case.depth} if name == "prb_projective" else {}
        integrator = mi.load_dict({"type": name, "hide_emitters": True, **options})
        measured(
            name,
            lambda seed: gradient_scenes.forward_image(mover, integrator, 16, seed),
            COARSE,
            seconds / 4,
            least=4,
        )

    if "fd" in parts:

        def difference(step):
            return lambda seed: SurfaceImage(mover, case, POINTS, seed).difference(step)

        measured("fd", difference(case.step), FINE, seconds)
        measured("half step", difference(case.step / 2), COARSE, seconds / 2)
    if "ours" in parts:

        def ours(light_edge_samples):
            return mi.load_dict(
                {
                    "type": "gshell_path",
                    "max_depth": case.depth,
                    "hide_emitters": True,
                    "light_edge_samples": light_edge_samples,
                }
            )

        def forward(integrator, spp, first_seed=0):
            return lambda seed: gradient_scenes.forward_image(mover, integrator, spp, first_seed + seed)

        many, few = ours(16.0), ours(1.0)
        measured("ours", forward(many, SPP), FINE, seconds)
        measured("few", forward(few, FEW, 10_000), few_error, 2 * seconds, least=32)
        reverse = gradient_scenes.reverse_derivative(mover, many, SPP, 0, weights)
        row["mismatch"] = abs(reverse - row["ours"][0]) / max(abs(reverse), 1e-9)
    if "stock" in parts:
        for name in STOCK:
            if name == "direct_projective" and case.depth != 2:
                row[name] = f"depth 2 only, scene needs {case.depth}"
                continue
            try:
                projected(name)
            except Exception as error:  # a stock integrator that cannot do a scene is a result
                row[name] = f"fails: {type(error).__name__}"
    RESULTS.mkdir(parents=True, exist_ok=True)
    np.savez(stored_at(case, resolution), row=json.dumps(row), **{f"image {k}": v for k, v in images.items()})


def stored_at(case, resolution):
    return RESULTS / f"{case.name}_{resolution}.npz"


def recall(case, resolution):
    """What ``measure`` kept of a scene: ``row`` and ``images``; empty if nothing."""
    path = stored_at(case, resolution)
    if not path.exists():
        return {}
    with np.load(path) as data:
        return {
            "case": case,
            "row": json.loads(str(data["row"])),
            "images": {k[6:]: data[k] for k in data if k.startswith("image ")},
        }


def agree(a, b, share=0.01):
    """Whether two means with standard errors differ by at most a share of the first or two errors."""
    return abs(a[0] - b[0]) <= max(share * abs(a[0]), 2 * np.hypot(a[1], b[1]))


def format_row(kept):
    case, row, images = kept["case"], kept["row"], kept["images"]
    means = {name: mean_and_error(x) for name, x in row.items() if isinstance(x, list)}

    def number(name):
        return "{:.2f} ± {:.2f}".format(*means[name]) if name in means else ""

    def stock(name):
        if name not in means:
            return row.get(name, "not run")
        return f"{number(name)} ({correlation(images['fd'], images[name]):.2f})"

    cells = [case.name, str(case.depth), f"{case.step:g}", number("fd"), number("half step"), number("ours")]
    if "fd" in means and "ours" in means:
        cells += [
            f"{100 * (means['ours'][0] / means['fd'][0] - 1):+.1f} %",
            "yes" if agree(means["fd"], means["ours"]) else "**no**",
            number("few"),
            "yes" if agree(means["fd"], means["few"]) else "**no**",
            f"{correlation(images['fd'], images['ours']):.3f}",
            f"{row['mismatch']:.0e}",
        ]
    else:
        cells += [""] * 6
    return "| " + " | ".join(cells + [stock(name) for name in STOCK]) + " |"


HEADER = """# Derivatives, measured

`python pipelines/validate_gradients.py` writes this page. Every scene has one mesh that moves with a scalar;
the derivative is that of a smoothly weighted sum of the image's colours. Figures after ± are one standard
error. "FD" are central finite differences of the stock `path` integrator with Richardson's extrapolation of
the steps h and 2 h, and the same with half of h. The two images of a difference share their random numbers
and are sampled at points fixed on the surfaces (`pipelines/surface_differences.py`). `gshell_path` has
its default `reparam_depth`, and `light_edge_samples` 16 at 128 spp, 1 at 4 spp. Every figure is repeated with
new seeds until its standard error is 0.3 % (1 % at 4 spp, half step, and for Mitsuba's integrators) or
the time is up. "Right": within 1 % of FD or two standard errors. "Corr.": correlation of the gradient image
with that of finite differences (both blurred by one pixel). "fwd - rev": relative difference of forward
and reverse mode with one seed. The last columns are Mitsuba's projective integrators with default
settings at 16 spp (in brackets their correlation).

"""

COLUMNS = (
    "scene",
    "depth",
    "h",
    "FD",
    "FD, h/2",
    f"gshell_path, {SPP} spp",
    "bias",
    "right",
    f"{FEW} spp",
    "right",
    "corr.",
    "fwd - rev",
    *STOCK,
)


def rows_on_page(path):
    """Name of the scene -> row of the table, as text, of a page written before."""
    lines = path.read_text().splitlines() if path.exists() else []
    names = {case.name for case in gradient_scenes.SCENES}
    rows = {line.split("|")[1].strip(): line for line in lines if line.count("|") == len(COLUMNS) + 1}
    return {name: line for name, line in rows.items() if name in names}


def write_page(measured, resolution):
    """Writes the page and the images; scenes that were not measured stay as they are on the page."""
    page = ROOT / "docs" / "gradients.md"
    table = {**rows_on_page(page), **{kept["case"].name: format_row(kept) for kept in measured}}
    cases = [case for case in gradient_scenes.SCENES if case.name in table]
    right = sum(table[case.name].count("| yes ") == 2 for case in cases)
    folder = ROOT / "docs" / "images"
    folder.mkdir(parents=True, exist_ok=True)
    for kept in measured:
        if not {"fd", "ours"} <= kept["images"].keys():
            continue
        reference, ours = kept["images"]["fd"], kept["images"]["ours"]
        scale = max(np.percentile(np.abs(gaussian_filter(reference[..., :3], (1, 1, 0))), 99), 1e-6)
        strip = np.concatenate([red_and_blue(x, scale) for x in (reference, ours, ours - reference)], 1)
        mi.Bitmap((255 * strip.repeat(2, 0).repeat(2, 1)).astype(np.uint8)).write(
            str(folder / f"gradients_{kept['case'].name}.png")
        )
    lines = [
        HEADER,
        f"{resolution}² pixels; Mitsuba {mi.__version__}, `{mi.variant()}`.\n\n",
        f"| {' | '.join(COLUMNS)} |\n",
        "|---" * len(COLUMNS) + "|\n",
    ]
    lines += [table[case.name] + "\n" for case in cases]
    lines.append(
        f"\n{right} of {len(cases)} scenes are right at both numbers of samples.\n\n"
        "## Gradient images\n\n"
        "Finite differences, `gshell_path`, difference; red positive, blue negative.\n\n"
    )
    lines += [
        f"**{case.name}**: {case.about}\n\n![{case.name}](images/gradients_{case.name}.png)\n\n"
        for case in cases
    ]
    notes = Path(__file__).with_name("gradients_notes.md")
    page.write_text(("".join(lines) + notes.read_text()).rstrip() + "\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scenes", nargs="*", help="names of scenes to measure (default all)")
    parser.add_argument("--resolution", type=int, default=64, help="pixels per side (default 64)")
    parser.add_argument(
        "--seconds", type=float, default=25, help="greatest processor time for one figure (default 25)"
    )
    parser.add_argument(
        "--few-error",
        type=float,
        default=COARSE,
        help="standard error, as a fraction, that ends the repeats at few samples, which may "
        "take twice the time of other figures (default 0.01)",
    )
    parser.add_argument(
        "--parts",
        nargs="*",
        choices=PARTS,
        default=PARTS,
        help="what to measure anew (default all): finite differences, gshell_path, Mitsuba's "
        "projective integrators",
    )
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default llvm_ad_rgb)")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    mi.set_log_level(mi.LogLevel.Error)
    for case in gradient_scenes.SCENES:
        if not arguments.scenes or case.name in arguments.scenes:
            measure(case, arguments.resolution, arguments.seconds, arguments.few_error, arguments.parts)
            print(format_row(recall(case, arguments.resolution)), flush=True)
    measured = [recall(case, arguments.resolution) for case in gradient_scenes.SCENES]
    write_page([kept for kept in measured if kept], arguments.resolution)


if __name__ == "__main__":
    main()
