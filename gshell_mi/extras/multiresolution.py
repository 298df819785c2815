"""Fields as sums of grids of several resolutions."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi

from ..fields.carried import Carried
from ..fields.smoothing import LatticeDiffusion
from ..lattice import BlockLattice, Lattice
from ..outliers import trusted
from ..parametrisation import ExplicitGrid
from ..parametrisation.parametrisation import CHANNELS, Parametrisation, StepRules, taken, touched
from ..schedules import decay_at

#: Coarse grids beside the lattice itself: of half its cells per side, a quarter, an eighth.
_COARSE_LEVELS = 3


class MultiresolutionGrid(Parametrisation):
    """The lattice's own values plus trilinear interpolations of coarser grids (``multiresolution``).

    The gradient of a coarse value collects those of all lattice vertices around it: coarse levels move whole
    parts and the lattice's own level moves details, which takes the place of a Sobolev gradient. All coarse
    levels start at 0, so the fields start exactly where they are told to.
    """

    def __init__(
        self, start: Mapping[str, mi.Float], lattice: Lattice | BlockLattice, rules: StepRules, seed: int = 0
    ):
        self.lattice, self.rules = lattice, rules
        sizes = (max(lattice.resolution >> level, 1) + 1 for level in range(1, _COARSE_LEVELS + 1))
        self._sizes = list(dict.fromkeys(sizes))
        self._names = tuple(name for name in CHANNELS if name in start)
        self.optimizer = mi.ad.Adam(lr=rules.rate, uniform=True)
        for name in self._names:
            self.optimizer[name] = mi.Float(start[name])
            for size in self._sizes:
                self.optimizer[f"{name}_{size}"] = dr.zeros(mi.Float, CHANNELS[name] * size**3)
        rest = {name: field for name, field in start.items() if name not in self._names}
        self._cubes = ExplicitGrid(rest, lattice, rules) if rest else None

    @property
    def optimizers(self) -> dict[str, mi.ad.Adam]:
        others = {"cubes": self._cubes.optimizer} if self._cubes else {}
        return {"geometry": self.optimizer} | others

    def fields(self) -> dict[str, mi.Float]:
        every = dr.arange(mi.UInt32, self.lattice.vertex_count)
        with dr.suspend_grad():
            fields = {name: self._at(name, every) for name in self._names}
        fields["deform"] = dr.clip(fields["deform"], -1, 1)
        dr.eval(fields)
        return fields | (self._cubes.fields() if self._cubes else {})

    def carry(self, carried: Carried) -> None:
        # The lattice's own level holds the start, which is nearly all of the field.
        carried.optimizer(self.optimizer, self._names)
        self.lattice = carried.after
        if self._cubes:
            self._cubes.carry(carried)

    def step(
        self,
        gradients: Mapping[str, mi.Float],
        progress: float,
        iteration: int = 0,
        diffuse: LatticeDiffusion | None = None,
    ) -> None:
        rules, optimizer = self.rules, self.optimizer
        own = {name: trusted(gradients[name]) for name in self._names}
        vertex = touched(own, self.lattice.vertex_count)
        if dr.width(vertex):
            total = mi.Float(0)
            for name, gradient in own.items():
                total += dr.sum(self._at(name, vertex) * taken(name, gradient, vertex))
            dr.backward(total)
        decay = decay_at(progress) / (1 + len(self._sizes))
        far, local = decay * rules.rate * self.lattice.spacing, decay * rules.deform_rate
        optimizer.set_learning_rate(
            {key: local if key.startswith("deform") else far for key in optimizer.keys()}
        )
        optimizer.step()
        if self._cubes:
            self._cubes.step({"weights": gradients["weights"]}, progress)

    def _at(self, name: str, vertex: mi.UInt32) -> mi.Float:
        """A field at some lattice vertices, channels interleaved, attached."""
        channels = CHANNELS[name]
        value = taken(name, self.optimizer[name], vertex)
        points = mi.Point3f(self.lattice.positions_of(vertex, mi.Float))
        for size in self._sizes:
            grid = mi.TensorXf(self.optimizer[f"{name}_{size}"], (size, size, size, channels))
            texture = mi.Texture3f(grid, wrap_mode=dr.WrapMode.Clamp)
            # From corner to corner of the cube, where texels are centred.
            texel = (0.5 * (points + 1) * (size - 1) + 0.5) / size
            value += dr.ravel(mi.ArrayXf(texture.eval(texel)))
        return value
