"""What all parametrisations of lattice fields have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..extraction.surface_mesh import gather
from ..fields.carried import Carried
from ..fields.smoothing import LatticeDiffusion

#: Values per lattice vertex of the fields that live there; the weights of FlexiCubes belong to cubes.
CHANNELS = {"sdf": 1, "msdf": 1, "deform": 3}


@dataclass(frozen=True)
class StepRules:
    """How far and how smoothly the fields move; the units do not depend on the lattice."""

    rate: float = 0.08
    """Largest change of ``sdf`` per step at the start, in cells; falls tenfold."""
    msdf_rate: float = 0.24
    """The same of ``msdf`` with ``explicit``; falls a hundredfold, as what noise has done to a rim stays. The
    other kinds move it as ``sdf``."""
    deform_rate: float = 0.02
    """The same of ``deform``, in units of the greatest offset that is allowed, and of ``weights``."""
    smoothing: float = 8.0
    """Lambda of the Sobolev gradient on the lattice at the start; only where lattice values are optimised."""
    detail: float = 0.5
    """Lambda at the end; falls geometrically. Nothing is smoothed if either is 0."""


class Parametrisation(ABC):
    """How the fields of a lattice hang on the parameters that an optimiser changes.

    An iteration of a fit takes ``fields()``, differentiates a loss with respect to them, and hands the
    gradients to ``step``. Only there the parametrisation looks at its parameters' derivatives, and only at
    the lattice vertices that have a gradient: these are those around the surface.

    Fields are flat: ``sdf`` and ``msdf`` one value per lattice vertex, ``deform`` three, and ``weights`` of
    FlexiCubes 21 per cube.
    """

    fitting_steps: int = 0
    """Calls of ``fit_step`` that bring the fields to what they are to start from; 0 if they start there."""

    is_explicit: bool = False
    """Whether the parameters are the values of the fields themselves."""

    moves_weights: bool = False
    """Whether the weights of FlexiCubes are among the fields that it is given in a fit."""

    @property
    @abstractmethod
    def optimizers(self) -> dict[str, mi.ad.Adam]:
        """The optimisers by name: all that has to be kept to go on later."""

    @abstractmethod
    def fields(self) -> dict[str, mi.Float]:
        """The present fields, detached."""

    @abstractmethod
    def step(
        self,
        gradients: Mapping[str, mi.Float],
        progress: float,
        iteration: int = 0,
        diffuse: LatticeDiffusion | None = None,
    ) -> None:
        """Moves the parameters.

        Args:
            gradients: of the loss with respect to each of the ``fields()``.
            progress: in [0, 1], of the whole fit.
            iteration: seeds what a step draws at random.
            diffuse: smooths the gradients of lattice values, where such are the parameters; by default on the
                whole lattice.
        """

    @abstractmethod
    def carry(self, carried: Carried) -> None:
        """Moves what is stored per vertex to other blocks of the lattice, see ``BlockLattice``."""

    def fit_step(self, iteration: int) -> dict[str, float]:
        """One step towards the fields to start from; returns the losses."""
        raise NotImplementedError

    def begin(self) -> None:  # noqa: B027 nothing to do without ``fit_step``
        """Forgets the momentum of the ``fit_step`` calls."""


def taken(name: str, field: mi.Float, vertex: mi.UInt32) -> mi.Float:
    """The values of a field at some lattice vertices, channels interleaved."""
    channels = CHANNELS[name]
    if channels == 1:
        return gather(mi.Float, field, vertex)
    lane = dr.arange(mi.UInt32, channels * dr.width(vertex))
    first = channels * dr.gather(mi.UInt32, vertex, lane // channels)
    return gather(mi.Float, field, first + lane % channels)


def touched(gradients: Mapping[str, mi.Float], vertex_count: int) -> mi.UInt32:
    """The lattice vertices where a gradient is not 0, ascending."""
    found = dr.full(mi.Bool, False, vertex_count)
    vertex = dr.arange(mi.UInt32, vertex_count)
    for name, gradient in gradients.items():
        for channel in range(CHANNELS[name]):
            found |= dr.gather(mi.Float, gradient, CHANNELS[name] * vertex + channel) != 0
    return dr.compress(found)
