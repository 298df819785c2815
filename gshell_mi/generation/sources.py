"""What a data set is made from: mesh files, the folders of fits, and garments by number."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path

import trimesh

from ..conversion.loaded_mesh import loaded_mesh
from ..errors import UserError
from ..json_files import read_json
from ..own_folder import MARK
from .garments import CLASSES, garment

#: Formats of mesh files, read by trimesh.
MESH_FILES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off", ".dae", ".3mf")

#: The class of meshes that no folder names.
UNNAMED = "object"


@dataclass(frozen=True)
class Source:
    """One object of a data set."""

    name: str
    """Unlike all others of the set."""
    kind: str
    """Its class."""
    path: str | None = None
    """Its file; None for a garment."""
    seed: int = 0
    """Of a garment."""

    def mesh(self) -> tuple[trimesh.Trimesh, int | None]:
        """The mesh, and the boundary loops it must have; None where nobody knows. Needs a variant.

        Raises:
            UserError: it cannot be read or has no faces.
        """
        if self.path is None:
            drawn = garment(self.kind, self.seed)
            return drawn.mesh, drawn.loops
        return loaded_mesh(self.path, self.path), None

    def is_held_out(self, fraction: float) -> bool:
        """Whether the object is for tests: by its name alone, so that sets made later agree.

        >>> sum(Source(f"dress-{i}", "dress").is_held_out(0.1) for i in range(1000))
        101
        """
        return int(hashlib.sha256(self.name.encode()).hexdigest()[:8], 16) < fraction * 2**32

    def to_dict(self) -> dict:
        return asdict(self)


def garment_sources(count: int, seed: int) -> list[Source]:
    """``count`` garments, the classes in turn.

    >>> [source.name for source in garment_sources(2, 7)]
    ['skirt-7-0', 'dress-7-0']
    """
    found = []
    for index in range(count):
        kind, number = CLASSES[index % len(CLASSES)], index // len(CLASSES)
        found.append(Source(f"{kind}-{seed}-{number}", kind, seed=seed * 1_000_003 + number))
    return found


def mesh_sources(places: list[Path]) -> list[Source]:
    """The meshes of files and folders, in the order of their names.

    Of a folder all mesh files in it and below are taken; the class is the first folder on the way to the
    file. Of the folder of a fit ``mesh.ply`` is taken.

    Raises:
        UserError: a place does not exist or holds no mesh.
    """
    found: list[Source] = []
    for place in places:
        if not place.exists():
            raise UserError(f"'{place}' does not exist; check the path.")
        here = _of_place(place)
        if not here:
            raise UserError(
                f"'{place}' holds no mesh ({', '.join(MESH_FILES)}) and is no finished fit; give "
                f"another place."
            )
        found += here
    names = [source.name for source in found]
    if len(set(names)) < len(names):  # places with files of the same names
        found = [
            Source(f"{index:06d}-{source.name}", source.kind, source.path)
            for index, source in enumerate(found)
        ]
    return found


def _of_place(place: Path) -> list[Source]:
    if place.is_file():
        return [Source(place.name, UNNAMED, str(place))] if place.suffix.lower() in MESH_FILES else []
    if _is_fit(place):
        path = place / "mesh.ply"
        return [Source(place.name, UNNAMED, str(path))] if path.is_file() else []
    found = []
    fits = {path.parent for path in place.rglob(MARK) if _is_fit(path.parent)}
    for path in sorted(place.rglob("*")):
        inside = next((fit for fit in path.parents if fit in fits), None)
        if (
            not path.is_file()
            or path.suffix.lower() not in MESH_FILES
            or (inside is not None and path != inside / "mesh.ply")
        ):
            continue
        relative = path.relative_to(place)
        kind = relative.parts[0] if len(relative.parts) > (1 if inside is None else 2) else UNNAMED
        found.append(Source(relative.as_posix(), kind, str(path)))
    return found


def _is_fit(folder: Path) -> bool:
    try:
        mark = read_json(folder / MARK)
    except (OSError, ValueError):
        return False
    return isinstance(mark, dict) and mark.get("kind") == "fit"
