"""Garments by class and seed."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
import trimesh

from ...errors import UserError
from ...extraction import extract
from ...lattice import CubeLattice
from ...topology import Topology, topology
from .kinds import KINDS

#: Names of the classes of garments.
CLASSES: tuple[str, ...] = tuple(KINDS)

#: Cells per side of the lattice that garments are cut out of.
_CELLS = 64
#: Numbers drawn anew at most so often, should two parts of a garment have run into each other.
_ATTEMPTS = 20


@dataclass(frozen=True)
class Garment:
    """An open garment, y up, within [-1, 1]^3."""

    kind: str
    """One of ``CLASSES``."""
    seed: int
    mesh: trimesh.Trimesh
    """One manifold, oriented component."""
    loops: int
    """Boundary loops."""
    parameters: dict[str, float]
    """What its shape was made from."""


def garment(kind: str, seed: int) -> Garment:
    """The garment of a class that belongs to a seed. Needs a Mitsuba variant.

    Numbers are drawn until the surface has one component and the loops that its cut promises.

    Raises:
        UserError: there is no such class.

    >>> drawn = garment("trousers", 3)
    >>> drawn.loops, drawn.mesh.body_count
    (3, 1)
    """
    if kind not in KINDS:
        raise UserError(f"class '{kind}' is none of those of garments; choose one of {', '.join(CLASSES)}")
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([CLASSES.index(kind), seed, attempt])
        parameters = KINDS[kind].draw(rng)
        mesh = _sewn(kind, parameters, rng)
        expected = KINDS[kind].loops(parameters)
        if mesh is not None and _is_right(topology(mesh.vertices, mesh.faces), expected):
            return Garment(kind, seed, mesh, expected, parameters)
    raise RuntimeError(f"no {kind} found for seed {seed}")


def _is_right(found: Topology, loops: int) -> bool:
    return (found.components, found.boundary_loops, found.pinholes, found.nonmanifold_edges) == (
        1, loops, 0, 0)


def _sewn(kind: str, parameters: dict[str, float], rng: np.random.Generator) -> trimesh.Trimesh | None:
    import mitsuba as mi

    lattice = CubeLattice(_CELLS)
    given = {name: dr.opaque(mi.Float, value) for name, value in parameters.items()}
    s, cut = KINDS[kind].fields(mi.Point3f(lattice.points(mi.Float)), given)
    vertices, faces, _ = extract(lattice, s, cut).to_numpy()
    if len(faces) == 0 or np.abs(vertices).max() > 0.999:  # it leaves the lattice
        return None
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    height = _folds(vertices, parameters) + _wrinkles(vertices, rng)
    folded = vertices + height[:, None] * mesh.vertex_normals
    return trimesh.Trimesh(_swayed(folded, rng), faces, process=False)


def _folds(p: np.ndarray, given: dict[str, float]) -> np.ndarray:
    """Height of the folds over the smooth cloth: waves around the y axis, deeper towards the hem."""
    x, y, z = p.T
    deep = np.clip((given["fold_top"] - y) / max(given["fold_top"] - given["fold_bottom"], 1e-3), 0, 1.2)
    turn = np.arctan2(z, x)
    phase = given["fold_count"] * turn + given["fold_phase"] + given["fold_turn"] * y
    # A second number of waves makes no two folds alike.
    second = np.sin((given["fold_count"] // 2 + 1) * turn + given["fold_second_phase"])
    wave = np.sin(phase + 0.7 * given["fold_second"] * second) * (1 + 0.5 * given["fold_second"] * second)
    return given["fold_depth"] * deep**1.5 * wave


def _wrinkles(p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Height of a few long waves in random directions."""
    height = np.zeros(len(p))
    for _ in range(4):
        wave = rng.normal(size=3)
        wave *= rng.uniform(4, 14) / np.linalg.norm(wave)
        height += rng.uniform(0.001, 0.007) * np.sin(p @ wave + rng.uniform(0, 2 * np.pi))
    return height


def _swayed(p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Bent to one side, turned about the vertical, and stretched a little."""
    p = p * rng.uniform(0.9, 1.1, 3)
    bend, twist = rng.normal(0, 0.05, 2), rng.normal(0, 0.12)
    x, y, z = p.T
    x, z = x + bend[0] * (y - y.max()) ** 2, z + bend[1] * (y - y.max()) ** 2
    angle = twist * (y - y.mean())
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=1)
