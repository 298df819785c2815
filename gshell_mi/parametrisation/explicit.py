"""The fields themselves as parameters."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi

from ..fields.carried import Carried
from ..fields.smoothing import LatticeDiffusion
from ..lattice import BlockLattice, Lattice
from ..outliers import trusted
from ..schedules import decay_at, falling
from ..tempered_adam import TemperedAdam
from .parametrisation import CHANNELS, Parametrisation, StepRules


class ExplicitGrid(Parametrisation):
    """One parameter per value of a field (``explicit``).

    The gradient is smoothed on the lattice (a Sobolev gradient: a step changes a region, not a vertex), and
    Adam takes one step size for the whole of a field: normalising each vertex on its own would undo the
    smoothing and let noise move the vertices that few pixels see as far as all others. The mSDF is told only
    where the surface ends, by few pixels and loudly where a rim stands out against what is behind it; with
    one step size the rest of a rim would stay ragged, so its steps are halfway to those of each vertex alone.

    Args:
        start: fields to start from, any of ``sdf``, ``msdf``, ``deform``, ``weights``.
        lattice: of the fields.
        rules: how far a step may go.
        seed: of nothing here.
    """

    is_explicit = True

    def __init__(
        self, start: Mapping[str, mi.Float], lattice: Lattice | BlockLattice, rules: StepRules, seed: int = 0
    ):
        self.lattice, self.rules = lattice, rules
        self.optimizer = mi.ad.Adam(lr=rules.rate, uniform=True)
        # What a mean over all pixels says of one vertex may be smaller than the epsilon that is usual.
        self.msdf_optimizer = TemperedAdam(lr=rules.msdf_rate, epsilon=1e-12)
        for name, field in start.items():
            self._optimizer_of(name)[name] = mi.Float(field)

    @property
    def optimizers(self) -> dict[str, mi.ad.Adam]:
        return {"geometry": self.optimizer, "msdf": self.msdf_optimizer}

    def fields(self) -> dict[str, mi.Float]:
        return {
            name: mi.Float(dr.detach(optimizer[name]))
            for optimizer in self.optimizers.values()
            for name in optimizer.keys()
        }

    def carry(self, carried: Carried) -> None:
        for optimizer in self.optimizers.values():
            carried.optimizer(optimizer, tuple(optimizer.keys()))
        self.lattice = carried.after

    def step(
        self,
        gradients: Mapping[str, mi.Float],
        progress: float,
        iteration: int = 0,
        diffuse: LatticeDiffusion | None = None,
    ) -> None:
        rules = self.rules
        decay = decay_at(progress)
        smoothing = falling(rules.smoothing, rules.detail, progress)
        diffuse = diffuse or LatticeDiffusion(self.lattice)
        spacing, local = self.lattice.spacing, rules.deform_rate
        rates = {
            "sdf": rules.rate * spacing,
            "msdf": decay * rules.msdf_rate * spacing,
            "deform": local,
            "weights": local,
        }
        steps = {name: trusted(gradient) for name, gradient in gradients.items()}
        steps |= diffuse.together({name: steps[name] for name in steps if name in CHANNELS}, smoothing)
        for name, gradient in steps.items():
            dr.set_grad(self._optimizer_of(name)[name], gradient)
        for optimizer in self.optimizers.values():
            optimizer.set_learning_rate({name: decay * rates[name] for name in optimizer.keys()})
            optimizer.step()
        if "deform" in gradients:
            self.optimizer["deform"] = dr.clip(self.optimizer["deform"], -1, 1)

    def _optimizer_of(self, name: str) -> mi.ad.Adam:
        return self.msdf_optimizer if name == "msdf" else self.optimizer
