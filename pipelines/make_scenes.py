"""Builds the scenes under ``scenes/`` from code: ``python pipelines/make_scenes.py [NAME ...] [-o scenes]``.

A new object is one module ``scene_builder/objects/NAME.py`` with ``build() -> SceneObject``. Needs
scikit-image (the package's extra ``test``). The same code gives the same files, up to the last bits
of floating point.
"""

import argparse
import importlib
import pkgutil
import sys
from pathlib import Path

import mitsuba as mi

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY / "pipelines"))


def names() -> list[str]:
    """The objects there are."""
    from scene_builder import objects

    return sorted(m.name for m in pkgutil.iter_modules(objects.__path__))


def main() -> None:
    known = names()
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"objects to build (default: {known})")
    parser.add_argument("-o", "--output", type=Path, default=REPOSITORY / "scenes", help="default: scenes")
    args = parser.parse_args()
    if unknown := set(args.names) - set(known):
        parser.error(f"no such object: {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    mi.set_variant("llvm_ad_rgb")
    from scene_builder.files import write_scene

    for name in args.names or known:
        item = importlib.import_module(f"scene_builder.objects.{name}").build()
        write_scene(name, item, args.output)
        print(f"{name}: {len(item.mesh.vertices)} vertices, {len(item.mesh.faces)} faces")


if __name__ == "__main__":
    main()
