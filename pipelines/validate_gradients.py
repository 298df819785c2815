"""Measures derivatives of ``gshell_path`` against finite differences and writes ``docs/gradients.md``.

    python pipelines/validate_gradients.py [--scenes NAME ...] [--resolution 64] [--seconds 25]

For every scene of ``pipelines/gradient_scenes.py``: the derivative of a weighted sum of the image's colours
and the gradient image, by central finite differences of the stock ``path`` integrator (equal seeds on both
sides, Richardson's extrapolation), by ``gshell_path`` in forward and reverse mode, and by Mitsuba's
``prb_projective`` and (at depth 2) ``direct_projective``. Figures after ± are one standard error over
independent repeats. Measurements are kept in ``out/gradients``; the page shows all that are there, and of
other scenes what it showed before.
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

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "out" / "gradients"

SPP, FD_SPP = 128, 512

#: More than the default: it lowers the noise of shadows as spp does that of all else
LIGHT_EDGE_SAMPLES = 16.0


def mean_and_error(values):
    values = np.asarray(values, float)
    return values.mean(), values.std(ddof=1) / np.sqrt(len(values))


def repeat(draw, goal, seconds, least=6, most=4096):
    """Calls ``draw(seed)`` until the mean's standard error is ``goal`` of it, or the time is up."""
    values, start = [], time.process_time()
    while len(values) < least or (len(values) < most and time.process_time() - start < seconds):
        values.append(draw(len(values)))
        if len(values) >= least:
            mean, error = mean_and_error(values)
            if error <= goal * abs(mean):
                break
    return values


def correlation(a, b):
    """Of two gradient images' colours, after a blur of one pixel that evens out their noise."""
    a, b = (gaussian_filter(x[..., :3], (1, 1, 0)).ravel() for x in (a, b))
    return float(np.corrcoef(a, b)[0, 1])


def red_and_blue(image, scale):
    """Positive values red, negative blue."""
    x = np.clip(image[..., :3].mean(-1) / scale, -1, 1)
    return np.stack([np.where(x > 0, 1, 1 + x), 1 - np.abs(x), np.where(x < 0, 1, 1 - x)], -1)


def measure(case, resolution, seconds, stock=True):
    """One row of the table with the gradient images, kept in ``out/gradients``."""
    mover = gradient_scenes.Mover(case, resolution)
    weights = gradient_scenes.image_weights(resolution)
    options = {"max_depth": case.depth, "hide_emitters": case.hide_emitters}
    ours = mi.load_dict({"type": "gshell_path", "reparam_depth": case.depth,
                         "light_edge_samples": LIGHT_EDGE_SAMPLES, **options})
    averages = {}

    def total(image):
        return float((image[..., :3].astype(float) * weights).sum())

    def remembered(name, image):
        mean, count = averages.get(name, (0, 0))
        averages[name] = (mean + (image - mean) / (count + 1), count + 1)
        return total(image)

    def finite_difference(seed):
        """Richardson's extrapolation of steps h and 2 h; the image is that of h / 2."""
        half, one, two = (gradient_scenes.finite_difference(mover, case, factor * case.step, spp, seed, 1)
                          for factor, spp in ((0.5, FD_SPP // 2), (1, FD_SPP), (2, FD_SPP // 2)))
        remembered("fd", half)
        return (4 * total(one) - total(two)) / 3

    def forward(seed, spp=SPP):
        return gradient_scenes.forward_image(mover, ours, spp, seed)

    kept = recall(case, resolution)
    if stock or not kept:
        fd = mean_and_error(repeat(finite_difference, 0.003, seconds))
        image = averages["fd"][0]
    else:
        fd, image = kept["fd"], kept["images"][0]
    derivative = repeat(lambda seed: remembered("ours", forward(seed)), 0.003, seconds)
    few = repeat(lambda seed: total(forward(10_000 + seed, 4)), 0.008, seconds / 3, least=32)
    first = total(forward(0))
    reverse = gradient_scenes.reverse_derivative(mover, ours, SPP, 0, weights)
    row = {"seconds": seconds, "fd": fd, "ours": mean_and_error(derivative),
           "few": mean_and_error(few), "mismatch": abs(reverse - first) / max(abs(reverse), 1e-9),
           "correlation": correlation(image, averages["ours"][0]),
           "stock": kept.get("stock", {})}
    for name in ("prb_projective", "direct_projective"):
        if not stock or (name == "direct_projective" and case.depth != 2):
            continue
        try:
            extra = {"max_depth": case.depth} if name == "prb_projective" else {}
            integrator = mi.load_dict({"type": name, "hide_emitters": case.hide_emitters, **extra})
            values = repeat(lambda seed: remembered(name, gradient_scenes.forward_image(     # noqa: B023
                mover, integrator, 16, seed)), 0.01, 0, least=3)     # noqa: B023
            row["stock"][name] = (*mean_and_error(values), correlation(image, averages[name][0]))
        except Exception as error:    # a stock integrator that cannot do a scene is a result
            row["stock"][name] = f"fails ({type(error).__name__})"
    RESULTS.mkdir(parents=True, exist_ok=True)
    np.savez(stored_at(case, resolution), row=json.dumps(row), fd=image, ours=averages["ours"][0])


def stored_at(case, resolution):
    return RESULTS / f"{case.name}_{resolution}.npz"


def recall(case, resolution):
    """What ``measure`` kept of a scene: its row and the images ``fd`` and ``ours``; empty if nothing."""
    path = stored_at(case, resolution)
    if not path.exists():
        return {}
    with np.load(path) as data:
        return {**json.loads(str(data["row"])), "case": case, "images": (data["fd"], data["ours"])}


def passes(row):
    """Bias within 1 % of the derivative or two standard errors, as the table judges it."""
    (fd, fd_error), (ours, error) = row["fd"], row["ours"]
    return abs(ours - fd) <= max(0.01 * abs(fd), 2 * np.hypot(fd_error, error))


def format_row(row):
    def number(mean, error):
        return f"{mean:.2f} ± {error:.2f}"

    fd, ours = row["fd"], row["ours"]
    cells = [row["case"].name, str(row["case"].depth), number(*fd), number(*ours),
             f"{100 * (ours[0] / fd[0] - 1):+.1f} %" if fd[0] else "", "yes" if passes(row) else "**no**",
             number(*row["few"]), f"{row['correlation']:.3f}", f"{row['mismatch']:.0e}"]
    for name in ("prb_projective", "direct_projective"):
        stock = row["stock"].get(name, "")
        cells.append(stock if isinstance(stock, str) else f"{number(*stock[:2])} ({stock[2]:.2f})")
    return "| " + " | ".join(cells) + " |"


HEADER = """# Derivatives, measured

`python pipelines/validate_gradients.py` writes this page. Every scene has one mesh that moves with a scalar;
the derivative is that of a smoothly weighted sum of the image's colours. "FD" are central finite
differences of the stock `path` integrator with equal seeds on both sides and Richardson's extrapolation of
two steps; figures after ± are one standard error. `gshell_path` uses `reparam_depth` = depth and
`light_edge_samples` = 16; every figure is repeated with new seeds until its standard error is 0.3 % or the
time is up. "Right" means: bias within 1 % of the derivative or within two
standard errors. "Corr." is the correlation of the gradient image with that of finite differences (both
blurred by one pixel); "fwd - rev" the relative difference of forward and reverse mode with one seed. The last
two columns show Mitsuba's projective integrators with default settings at 16 spp (in brackets their
correlation).

"""


def rows_on_page(path):
    """Name of the scene -> row of the table, as text, of a page written before."""
    lines = path.read_text().splitlines() if path.exists() else []
    names = {case.name for case in gradient_scenes.SCENES}
    rows = {line.split("|")[1].strip(): line for line in lines if line.count("|") == 12}
    return {name: line for name, line in rows.items() if name in names}


def write_page(rows, resolution):
    """Writes the page and the images of ``rows``; scenes without a row stay as they are on the page."""
    page = ROOT / "docs" / "gradients.md"
    table = {**rows_on_page(page), **{row["case"].name: format_row(row) for row in rows}}
    cases = [case for case in gradient_scenes.SCENES if case.name in table]
    right = sum(table[case.name].split("|")[6].strip() == "yes" for case in cases)
    folder = ROOT / "docs" / "images"
    folder.mkdir(parents=True, exist_ok=True)
    for row in rows:
        reference, ours = row["images"]
        scale = max(np.percentile(np.abs(gaussian_filter(reference[..., :3], (1, 1, 0))), 99), 1e-6)
        strip = np.concatenate([red_and_blue(x, scale) for x in (reference, ours, ours - reference)], 1)
        mi.Bitmap((255 * strip.repeat(2, 0).repeat(2, 1)).astype(np.uint8)).write(
            str(folder / f"gradients_{row['case'].name}.png"))
    lines = [HEADER, f"{resolution}² pixels; Mitsuba {mi.__version__}, `{mi.variant()}`"
             f", up to {max(row['seconds'] for row in rows):g} s of processor time per figure.\n\n",
             f"| scene | depth | FD | gshell_path, {SPP} spp | bias | right | 4 spp "
             "| corr. | fwd - rev | prb_projective | direct_projective |\n",
             "|---|---|---|---|---|---|---|---|---|---|---|\n"]
    lines += [table[case.name] + "\n" for case in cases]
    lines.append(f"\n{right} of {len(cases)} scenes are right.\n\n## Gradient images\n\n"
                 "Finite differences, `gshell_path`, difference; red positive, blue negative.\n\n")
    lines += [f"**{case.name}**: {case.about}\n\n![{case.name}](images/gradients_{case.name}.png)\n\n"
              for case in cases]
    notes = Path(__file__).with_name("gradients_notes.md")
    if notes.exists():
        lines.append(notes.read_text())
    page.write_text("".join(lines).rstrip() + "\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scenes", nargs="*", help="names of scenes to measure (default all)")
    parser.add_argument("--resolution", type=int, default=64, help="pixels per side (default 64)")
    parser.add_argument("--seconds", type=float, default=25,
                        help="greatest processor time for one figure (default 25)")
    parser.add_argument("--ours", action="store_true",
                        help="measure gshell_path anew, and keep what was measured of the others")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default llvm_ad_rgb)")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    mi.set_log_level(mi.LogLevel.Error)
    for case in gradient_scenes.SCENES:
        if not arguments.scenes or case.name in arguments.scenes:
            measure(case, arguments.resolution, arguments.seconds, not arguments.ours)
            print(format_row(recall(case, arguments.resolution)), flush=True)
    rows = [recall(case, arguments.resolution) for case in gradient_scenes.SCENES]
    write_page([row for row in rows if row], arguments.resolution)


if __name__ == "__main__":
    main()
