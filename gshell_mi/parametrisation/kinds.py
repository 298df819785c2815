"""The parametrisations by name."""

from __future__ import annotations

from collections.abc import Mapping

import mitsuba as mi

from ..errors import UserError
from ..lattice import BlockLattice, Lattice
from .explicit import ExplicitGrid
from .parametrisation import Parametrisation, StepRules

#: Those that there are; ``register_parametrisation`` adds to them.
_KINDS: dict[str, type[Parametrisation]] = {"explicit": ExplicitGrid}


def register_parametrisation(name: str, kind: type[Parametrisation]) -> None:
    """Lets ``make_parametrisation`` and ``--model.field`` know another one.

    Args:
        name: what it is called.
        kind: its class, made as ``kind(start, lattice, rules, seed)``.
    """
    _KINDS[name] = kind


def parametrisation_named(name: str) -> type[Parametrisation]:
    """The class of the parametrisation ``name``.

    Raises:
        UserError: there is no such parametrisation.
    """
    if name not in _KINDS:
        raise UserError(f"field '{name}' is not available; choose one of {', '.join(_KINDS)}")
    return _KINDS[name]


def make_parametrisation(
    name: str,
    start: Mapping[str, mi.Float],
    lattice: Lattice | BlockLattice,
    rules: StepRules | None = None,
    *,
    seed: int = 0,
) -> Parametrisation:
    """The parametrisation ``name`` of the fields of a lattice.

    Args:
        name: ``explicit`` or one that is registered, as those of ``gshell_mi.extras``.
        start: the fields to start from: flat ``sdf``, ``msdf``, ``deform`` and, for FlexiCubes, ``weights``.
        lattice: of the fields.
        rules: how far a step may go.
        seed: of what is random in it.

    Raises:
        UserError: there is no such parametrisation.

    >>> import drjit as dr, mitsuba as mi
    >>> from gshell_mi.lattice import TetLattice
    >>> lattice = TetLattice(16)
    >>> ball = dr.norm(lattice.points(mi.Float)) - 0.5
    >>> start = {"sdf": ball, "msdf": dr.ones(mi.Float, 17**3), "deform": dr.zeros(mi.Float, 3 * 17**3)}
    >>> fields = make_parametrisation("explicit", start, lattice)
    >>> grow = dr.full(mi.Float, -1, 17**3)
    >>> gradients = {"sdf": -grow, "msdf": 0 * grow, "deform": dr.zeros(mi.Float, 3 * 17**3)}
    >>> fields.step(gradients, progress=0)
    >>> bool(dr.all(fields.fields()["sdf"] < ball)[0])
    True
    """
    kind = parametrisation_named(name)
    # The base class does not say how its kinds are made, but all are made like this.
    return kind(start, lattice, rules or StepRules(), seed)  # pyright: ignore[reportCallIssue]
