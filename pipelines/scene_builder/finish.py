"""The finish of a true object: relief, print and gloss far finer than a lattice's cells."""

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

from gshell_mi.errors import UserError

from .faults import Dice, Faults

#: Of relief and print, in fractions of the object's largest extent.
RELIEF_PERIOD, PRINT_PERIOD = 0.035, 0.055
#: So many edges make up a period of the relief, at least.
_EDGES = 5


@dataclass(frozen=True)
class Subject:
    """A true object as its scene has it."""

    vertices: np.ndarray
    """``(n, 3)``."""
    faces: np.ndarray
    color: np.ndarray
    """Linear base colour per vertex, ``(n, 3)``."""
    roughness: float
    metallic: float

    @property
    def extent(self) -> float:
        """The longest side of the bounding box."""
        return float(np.ptp(self.vertices, axis=0).max())


def load_subject(reference: Path) -> Subject:
    """The object of a scene's ``reference.xml``.

    Raises:
        UserError: the file is missing or no scene, or not one mesh with one principled material.
    """
    if not Path(reference).is_file():
        raise UserError(f"'{reference}' does not exist; give a scene's reference.xml.")
    from gshell_mi.scene_files import load_scene

    scene = load_scene(Path(reference))
    values = mi.traverse(scene)
    if len(scene.shapes()) != 1 or "subject.vertex_positions" not in values:
        raise UserError(
            f"'{reference}' has no mesh 'subject', or other shapes beside it; give the "
            f"reference.xml of one of the scenes in scenes/."
        )
    vertices = np.array(values["subject.vertex_positions"], float).reshape(-1, 3)
    color = np.full_like(vertices, 0.5)
    if "subject.vertex_color" in values:
        color = np.array(values["subject.vertex_color"], float).reshape(-1, 3)

    def uniform(name: str, default: float) -> float:
        found = [key for key in values.keys() if key.endswith(f".{name}.value")]
        return float(np.ravel(values[found[0]])[0]) if found else default

    return Subject(
        vertices,
        np.array(values["subject.faces"]).reshape(-1, 3),
        color,
        uniform("roughness", 0.8),
        uniform("metallic", 0.0),
    )


def finished(subject: Subject, faults: Faults, dice: Dice) -> Subject:
    """The object with relief, print and gloss, subdivided until it can hold them."""
    vertices, faces, color = subject.vertices, subject.faces, subject.color
    if faults.relief or faults.print:
        limit = RELIEF_PERIOD * subject.extent / _EDGES
        while np.median(_edge_lengths(vertices, faces)) > limit:
            vertices, faces, attributes = trimesh.remesh.subdivide(
                vertices, faces, vertex_attributes={"color": color}
            )
            color = attributes["color"]
    unit = vertices / subject.extent
    if faults.print:
        ink = faults.print / (1 + np.exp(-8 * _waves(unit, PRINT_PERIOD, dice("print"))))
        # Of another hue whatever the cloth's, and darker.
        color = color + ink[:, None] * (0.5 * np.roll(color, 1, axis=1) - color)
    if faults.relief:
        normals = trimesh.Trimesh(vertices, faces, process=False).vertex_normals
        # Cosines of random phases: rarely beyond twice their root mean square, 1.
        height = 0.5 * np.clip(_waves(unit, RELIEF_PERIOD, dice("relief")), -2, 2)
        vertices = vertices + faults.relief / 100 * subject.extent * height[:, None] * normals
    return Subject(vertices, faces, color, subject.roughness * (1 - faults.gloss), subject.metallic)


def _waves(points: np.ndarray, period: float, rng: np.random.Generator) -> np.ndarray:
    """A sum of plane waves of about one period in all directions, root mean square 1."""
    count = 16
    ways = rng.standard_normal((count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    ways *= 2 * np.pi / period * rng.uniform(0.7, 1.3, (count, 1))
    return np.cos(points @ ways.T + rng.uniform(0, 2 * np.pi, count)).sum(1) * np.sqrt(2 / count)


def _edge_lengths(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=-1)
