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
from .parametrisation import CHANNELS, Parametrisation, StepRules


class ExplicitGrid(Parametrisation):
    """One parameter per value of a field (``explicit``).

    The gradient is smoothed on the lattice (a Sobolev gradient: a step changes a region, not a vertex), and
    Adam takes one step size for the whole of a field: normalising each vertex on its own would undo the
    smoothing and let noise move the vertices that few pixels see as far as all others.

    Args:
        start: fields to start from, any of ``sdf``, ``msdf``, ``deform``, ``weights``.
    """

    def __init__(self, start: Mapping[str, mi.Float], lattice: Lattice | BlockLattice, rules: StepRules):
        self.lattice, self.rules = lattice, rules
        self.optimizer = mi.ad.Adam(lr=rules.rate, uniform=True)
        for name, field in start.items():
            self.optimizer[name] = mi.Float(field)

    @property
    def optimizers(self) -> dict[str, mi.ad.Adam]:
        return {"geometry": self.optimizer}

    def fields(self) -> dict[str, mi.Float]:
        return {name: mi.Float(dr.detach(self.optimizer[name])) for name in self.optimizer.keys()}

    def carry(self, carried: Carried) -> None:
        carried.optimizer(self.optimizer, tuple(self.optimizer.keys()))
        self.lattice = carried.after

    def step(self, gradients: Mapping[str, mi.Float], progress: float, iteration: int = 0,
             diffuse: LatticeDiffusion | None = None) -> None:
        rules, optimizer = self.rules, self.optimizer
        decay = decay_at(progress)
        smoothing = falling(rules.smoothing, rules.detail, progress)
        diffuse = diffuse or LatticeDiffusion(self.lattice)
        far, local = decay * rules.rate * self.lattice.spacing, decay * rules.deform_rate
        rates = {"sdf": far, "msdf": far, "deform": local, "weights": local}
        steps = {name: trusted(gradient) for name, gradient in gradients.items()}
        steps |= diffuse.together({name: steps[name] for name in steps if name in CHANNELS}, smoothing)
        for name, gradient in steps.items():
            dr.set_grad(optimizer[name], gradient)
        optimizer.set_learning_rate({name: rates[name] for name in gradients})
        optimizer.step()
        if "deform" in gradients:
            optimizer["deform"] = dr.clip(optimizer["deform"], -1, 1)
