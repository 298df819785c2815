"""The cases of the regression net: what is fitted, and the captures that are made for it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

REPOSITORY = Path(__file__).parents[2]
sys.path.insert(0, str(REPOSITORY / "pipelines"))

from fit_study.trials import Trial  # noqa: E402
from scene_builder import cameras, faults, files, finish, photographs  # noqa: E402
from scene_builder.faults import Faults  # noqa: E402
from scene_builder.photographs import Photographs, write_photographs  # noqa: E402

from gshell_mi.capture import import_capture  # noqa: E402
from gshell_mi.fit import FitConfig  # noqa: E402

SCENES = REPOSITORY / "scenes"
EXPECTED = Path(__file__).parent / "expected"


@dataclass(frozen=True)
class Case:
    """A fit with default settings, or of less effort.

    Attributes:
        name: of the case, and of its file in ``expected``.
        prepare: makes the trial; the argument is a folder that it may write into.
    """

    name: str
    prepare: Callable[[Path], Trial]

    @property
    def expected(self) -> Path:
        return EXPECTED / f"{self.name}.json"


def _stock(name: str, _: Path) -> Trial:
    return Trial(SCENES / f"{name}.xml", "default", FitConfig())


def _small(name: str, folder: Path) -> Trial:
    scene = write_small_scene(SCENES / f"{name}.xml", folder / "small", every=2, size=128)
    return Trial(scene, "preview", FitConfig.for_effort("preview"))


def write_small_scene(scene: Path, folder: Path, *, every: int, size: int) -> Path:
    """A copy of a scene of ``scenes/`` with each ``every``-th view, ``size`` pixels wide; returns its file.

    What is there already stays, so that its rendered targets serve the next run too.
    """
    small, inside = folder / f"small_{scene.name}", scene.with_suffix("")
    if small.exists():
        return small
    beside = small.with_suffix("")
    beside.mkdir(parents=True, exist_ok=True)
    for name in ("truth.ply", "light.exr", "reference.xml", "test.xml"):
        shutil.copyfile(inside / name, beside / name)
    sensors = ElementTree.parse(inside / "sensors.xml")
    for number, sensor in enumerate(sensors.getroot().findall("sensor")):
        if number % every:
            sensors.getroot().remove(sensor)
        for side in ("width", "height"):
            sensor.find(f"film/integer[@name='{side}']").set("value", str(size))
    sensors.write(beside / "sensors.xml")
    text = scene.read_text()
    small.write_text(text.replace(f"{scene.stem}/sensors.xml", f"{small.stem}/sensors.xml"))
    return small


def _photographed(name: str, sizes: Faults, folder: Path) -> Trial:
    what = Photographs(SCENES / name / "reference.xml", sizes)
    # Another builder or another truth makes another capture.
    place = folder / "captures" / f"{name}-{_digest(what)}"
    if not place.exists():
        write_photographs(what, place)
    scene = place / f"photographed_{name}.xml"
    if not scene.exists():
        import_capture(place / "capture", scene)
    return Trial(scene, "default", FitConfig(), truth=place / "truth")


def _digest(what: Photographs) -> str:
    digest = hashlib.sha256(json.dumps(dataclasses.asdict(what) | {"reference": ""}).encode())
    sources = [Path(module.__file__) for module in (cameras, faults, files, finish, photographs)]
    inside = what.reference.parent
    for path in (*sources, what.reference, inside / "truth.ply", inside / "light.exr"):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


#: The fit that `make test` makes too, through all stages in a minute or two: small views, least effort.
SMALL = Case("small_skirt", partial(_small, "skirt"))

CASES = [
    SMALL,
    *(Case(path.stem, partial(_stock, path.stem)) for path in sorted(SCENES.glob("*.xml"))),
    # Satin with pressed relief, a matt print, a glazed figure: open, open, closed.
    Case("photographed_skirt", partial(_photographed, "skirt", Faults(print=0.3, gloss=0.7, relief=0.5))),
    Case("photographed_tshirt", partial(_photographed, "tshirt", Faults(print=1.0, gloss=0.0, relief=0.1))),
    Case("photographed_bunny", partial(_photographed, "bunny", Faults(print=0.5, gloss=0.6, relief=0.2))),
]
