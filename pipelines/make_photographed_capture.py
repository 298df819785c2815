"""Photographs one of our scenes as people do, faults included, with the truth to score by.

    python pipelines/make_photographed_capture.py scenes/skirt/reference.xml out/captures/skirt
    python -m gshell_mi.capture out/captures/skirt/capture -o out/captures/skirt/skirt.xml
    python -m gshell_mi.fit out/captures/skirt/skirt.xml -o out/captures/fit
    python -m gshell_mi.compare out/captures/fit --sensors out/captures/skirt/truth/test.xml \\
        --targets out/captures/skirt/truth/test --mesh out/captures/skirt/truth/truth.ply

The object gets relief, print and gloss finer than a lattice holds; the photographs are 8-bit sRGB with wrong
poses, exposures and masks, close-ups, a stand and noise. Each fault has an option with its size, 0 is without
it; --clean is without all but those that are given. The same options give the same files.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from command_reference import field_texts  # noqa: E402

from gshell_mi.doctor import ensure_variant  # noqa: E402
from gshell_mi.errors import UserError  # noqa: E402


def main(given: list[str] | None = None) -> int:
    from scene_builder.faults import CLEAN, Faults

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("reference", type=Path, help="a stock scene: scenes/skirt/reference.xml")
    parser.add_argument("output", type=Path, help="a new folder, for capture/ and truth/")
    parser.add_argument("--views", type=int, default=60, help="photographs (default 60)")
    parser.add_argument("--size", type=int, default=400, help="pixels per side (default 400)")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel (default 64)")
    parser.add_argument("--seed", type=int, default=0, help="of all that is random (default 0)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default llvm_ad_rgb)")
    parser.add_argument("--clean", action="store_true", help="no faults but those that are given")
    texts = field_texts(Faults)
    for field in dataclasses.fields(Faults):
        text = texts[field.name].replace("%", "%%")
        parser.add_argument(
            f"--{field.name.replace('_', '-')}",
            type=type(field.default),
            help=f"{text} (default {field.default:g})",
        )
    arguments = parser.parse_args(given)
    chosen = {
        field.name: getattr(arguments, field.name)
        for field in dataclasses.fields(Faults)
        if getattr(arguments, field.name) is not None
    }

    def progress(done: int, count: int) -> None:
        print(f"\r{done} / {count}", end="\n" if done == count else "", file=sys.stderr, flush=True)

    try:
        faults = dataclasses.replace(CLEAN if arguments.clean else Faults(), **chosen)
        ensure_variant(arguments.variant)
        from scene_builder.photographs import Photographs, write_photographs

        what = Photographs(
            arguments.reference, faults, arguments.views, arguments.size, arguments.spp, arguments.seed
        )
        write_photographs(what, arguments.output, progress)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
