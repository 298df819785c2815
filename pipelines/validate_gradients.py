"""Measures derivatives of ``gshell_path`` against finite differences and writes ``docs/gradients.md``.

    python pipelines/validate_gradients.py [--scenes NAME ...] [--resolution 64] [--quick]

For every scene of ``pipelines/gradient_scenes.py``: the derivative of a weighted sum of the image's colours
and the gradient image, by central finite differences of the stock ``path`` integrator (equal seeds on both
sides), by ``gshell_path`` in forward and reverse mode, and by Mitsuba's ``prb_projective`` and (at depth 2)
``direct_projective``. Figures after ± are one standard error over independent repeats.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
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


def mean_and_error(values):
    values = np.asarray(values, float)
    return values.mean(), values.std(ddof=1) / np.sqrt(len(values))


def correlation(a, b):
    """Of two gradient images' colours, after a blur of one pixel that evens out their noise."""
    a, b = (gaussian_filter(x[..., :3], (1, 1, 0)).ravel() for x in (a, b))
    return float(np.corrcoef(a, b)[0, 1])


def red_and_blue(image, scale):
    """Positive values red, negative blue."""
    x = np.clip(image[..., :3].mean(-1) / scale, -1, 1)
    return np.stack([np.where(x > 0, 1, 1 + x), 1 - np.abs(x), np.where(x < 0, 1, 1 - x)], -1)


def measure(case, resolution, quick, stock=True):
    """One row of the table, and the gradient images of finite differences and of ``gshell_path``."""
    fewer = 4 if quick else 1
    mover = gradient_scenes.Mover(case, resolution)
    weights = gradient_scenes.image_weights(resolution)

    def total(images):
        return [(image[..., :3] * weights).sum() for image in images]

    reference = gradient_scenes.finite_differences(mover, case, 1024 // fewer, 8)
    options = {"max_depth": case.depth, "hide_emitters": case.hide_emitters}
    ours = mi.load_dict({"type": "gshell_path", "reparam_depth": case.depth, **options})
    start = time.perf_counter()
    forward = np.array([gradient_scenes.forward_image(mover, ours, 128 // fewer, seed) for seed in range(16)])
    seconds = (time.perf_counter() - start) / 16
    few = np.array([gradient_scenes.forward_image(mover, ours, 4, seed) for seed in range(64 // fewer)])
    reverse = gradient_scenes.reverse_derivative(mover, ours, 128 // fewer, 0, weights)
    mismatch = abs(reverse - total(forward[:1])[0]) / max(abs(reverse), 1e-9)
    row = {"case": case, "fd": mean_and_error(total(reference)), "ours": mean_and_error(total(forward)),
           "few": mean_and_error(total(few)), "mismatch": mismatch, "seconds": seconds,
           "correlation": correlation(reference.mean(0), forward.mean(0)), "stock": {}}
    for name in ("prb_projective", "direct_projective"):
        if not stock or (name == "direct_projective" and case.depth != 2):
            continue
        try:
            extra = {"max_depth": case.depth} if name == "prb_projective" else {}
            integrator = mi.load_dict({"type": name, "hide_emitters": case.hide_emitters, **extra})
            images = [gradient_scenes.forward_image(mover, integrator, 8, seed) for seed in range(3)]
            row["stock"][name] = (*mean_and_error(total(images)),
                                  correlation(reference.mean(0), np.mean(images, 0)))
        except Exception as error:    # a stock integrator that cannot do a scene is a result
            row["stock"][name] = f"fails ({type(error).__name__})"
    return row, reference.mean(0), forward.mean(0)


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
the derivative is that of a smoothly weighted sum of the image's colours. "FD" are central finite differences
of the stock `path` integrator with equal seeds on both sides; figures after ± are one standard error.
`gshell_path` uses `reparam_depth` = depth. "Right" means: bias within 1 % of the derivative or within two
standard errors. "Corr." is the correlation of the gradient image with that of finite differences (both
blurred by one pixel); "fwd - rev" the relative difference of forward and reverse mode with one seed. The last
two columns show Mitsuba's projective integrators with default settings at 8 spp (in brackets their
correlation).

"""


def write_page(rows, images, resolution, quick):
    folder = ROOT / "docs" / "images"
    folder.mkdir(parents=True, exist_ok=True)
    for name, (reference, ours) in images.items():
        scale = max(np.percentile(np.abs(gaussian_filter(reference[..., :3], (1, 1, 0))), 99), 1e-6)
        strip = np.concatenate([red_and_blue(x, scale) for x in (reference, ours, ours - reference)], 1)
        mi.Bitmap((255 * strip.repeat(2, 0).repeat(2, 1)).astype(np.uint8)).write(
            str(folder / f"gradients_{name}.png"))
    lines = [HEADER, f"{resolution}² pixels; Mitsuba {mi.__version__}, `{mi.variant()}`"
             f"{', --quick' if quick else ''}. "
             "Rows without figures of the projective integrators were run with --ours.\n\n",
             f"| scene | depth | FD | gshell_path, {32 if quick else 128} spp | bias | right | 4 spp "
             "| corr. | fwd - rev | prb_projective | direct_projective |\n",
             "|---|---|---|---|---|---|---|---|---|---|---|\n"]
    lines += [format_row(row) + "\n" for row in rows]
    lines.append(f"\n{sum(map(passes, rows))} of {len(rows)} scenes are right.\n\n## Gradient images\n\n"
                 "Finite differences, `gshell_path`, difference; red positive, blue negative.\n\n")
    lines += [f"**{row['case'].name}**: {row['case'].about}\n\n"
              f"![{row['case'].name}](images/gradients_{row['case'].name}.png)\n\n" for row in rows]
    notes = Path(__file__).with_name("gradients_notes.md")
    if notes.exists():
        lines.append(notes.read_text())
    (ROOT / "docs" / "gradients.md").write_text("".join(lines).rstrip() + "\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scenes", nargs="*", help="names of scenes; the page is only written for all")
    parser.add_argument("--resolution", type=int, default=64, help="pixels per side (default 64)")
    parser.add_argument("--quick", action="store_true", help="a quarter of the samples")
    parser.add_argument("--ours", action="store_true", help="leave out the stock integrators")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default llvm_ad_rgb)")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    mi.set_log_level(mi.LogLevel.Error)
    cases = [c for c in gradient_scenes.SCENES if not arguments.scenes or c.name in arguments.scenes]
    rows, images = [], {}
    for case in cases:
        row, reference, ours = measure(case, arguments.resolution, arguments.quick, not arguments.ours)
        rows.append(row)
        images[case.name] = (reference, ours)
        print(format_row(row), flush=True)
        if not arguments.scenes:
            write_page(rows, images, arguments.resolution, arguments.quick)


if __name__ == "__main__":
    main()
