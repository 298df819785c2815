"""Garments by class and seed."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
import trimesh

from ...arrays import Float
from ...errors import UserError
from ...extraction import extract
from ...lattice import CubeLattice
from ...topology import Topology, topology
from .folds import folds, wrinkles
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
        UserError: there is no such class, or no attempt has come out so.

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
    raise UserError(f"no {kind} of seed {seed} came out right in {_ATTEMPTS} attempts; choose another seed")


def _is_right(found: Topology, loops: int) -> bool:
    return (found.components, found.boundary_loops, found.pinholes, found.nonmanifold_edges) == (
        1,
        loops,
        0,
        0,
    )


def _sewn(kind: str, parameters: dict[str, float], rng: np.random.Generator) -> trimesh.Trimesh | None:
    import mitsuba as mi

    lattice = CubeLattice(_CELLS)
    points = mi.Point3f(lattice.points(mi.Float))
    given = {name: dr.opaque(mi.Float, value) for name, value in parameters.items()}
    s, cut = KINDS[kind].fields(points, given)
    # A level set has no faces turned over, however sharply its normals turn; moved vertices would.
    height = folds(points, given) + wrinkles(points, rng)
    vertices, faces, _ = extract(lattice, s - height * _steepness(s, lattice), cut).to_numpy()
    if len(faces) == 0 or np.abs(vertices).max() > 0.999:  # it leaves the lattice
        return None
    return trimesh.Trimesh(_swayed(vertices, rng), faces, process=False)


def _steepness(s: Float, lattice: CubeLattice) -> Float:
    """How much a field changes over a unit of length: 1 if it is a distance."""
    grid = s.numpy().reshape((lattice.stride,) * 3)
    return type(s)(np.linalg.norm(np.gradient(grid, lattice.spacing), axis=0).astype(np.float32).ravel())


def _swayed(p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Bent to one side, turned about the vertical, and stretched a little."""
    p = p * rng.uniform(0.9, 1.1, 3)
    bend, twist = rng.normal(0, 0.05, 2), rng.normal(0, 0.12)
    x, y, z = p.T
    x, z = x + bend[0] * (y - y.max()) ** 2, z + bend[1] * (y - y.max()) ** 2
    angle = twist * (y - y.mean())
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=1)
