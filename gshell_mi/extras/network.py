"""Fields as the outputs of a small network of the position."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit import nn

from ..fields.carried import Carried
from ..fields.smoothing import LatticeDiffusion
from ..lattice import BlockLattice, Lattice
from ..outliers import finite, trusted
from ..parametrisation import ExplicitGrid
from ..parametrisation.parametrisation import CHANNELS, Parametrisation, StepRules, taken, touched
from ..schedules import decay_at

#: Outputs of the network: sdf, msdf, deform.
_OUTPUTS = 5

#: A field of this many cells is an output of 1.
_UNIT_CELLS = 4.0

#: The fields matter this near the surface, in cells: most samples of the fit to the start lie here.
_NEAR_CELLS = 2.5

#: Lattice vertices per step of the fit to the start.
_BATCH = 8192

#: Points per step of the eikonal loss, and its weight, which falls tenfold.
_EIKONAL_BATCH, _EIKONAL_WEIGHT = 2048, 0.1

#: Largest root mean square movement of a field around the surface, as a part of ``StepRules.rate``: about
#: what the explicit grid reaches, where the rate is that of the fastest vertex.
_LARGEST_STEP = 0.3

#: Lattice vertices that the network is evaluated at together.
_PIECE = 65536

#: Points are padded to multiples of this, as kernels of tensors contain their shape.
_PADDING = 4096


class NetworkFields(Parametrisation):
    """Base of the parametrisations in which one network makes ``sdf``, ``msdf`` and ``deform``.

    Before anything else the network is fitted to the fields to start from. It is evaluated at all lattice
    vertices without derivatives, and again with derivatives at those that the loss depends on.

    Args:
        start: fields to start from; ``weights`` of FlexiCubes stay parameters of their own.
        seed: of the initial network and of the samples of the fit to the start.
    """

    rate: float
    """Adam's step in a fit; falls tenfold. It is shortened where the fields would move too far."""
    fitting_rate: float
    """Adam's first step of the fit to the start; falls hundredfold."""

    def __init__(
        self, start: Mapping[str, mi.Float], lattice: Lattice | BlockLattice, rules: StepRules, seed: int
    ):
        self.lattice, self.rules, self.seed = lattice, rules, seed
        self._start = {name: mi.Float(start[name]) for name in ("sdf", "msdf", "deform") if name in start}
        self._near = dr.compress(dr.abs(self._start["sdf"]) < _NEAR_CELLS * lattice.spacing)
        self.network = self.make_network(dr.rng(seed=seed + 1))
        self._begin(self.fitting_rate)
        cubes = {name: field for name, field in start.items() if name not in self._start}
        self._cubes = ExplicitGrid(cubes, lattice, rules) if cubes else None

    @abstractmethod
    def make_network(self, rng: dr.random.Generator) -> nn.Module:
        """The network from what ``encode`` returns to five outputs, with its initial weights."""

    @abstractmethod
    def encode(self, points: mi.Point3f) -> mi.TensorXf:
        """The network's input, (features, n), at points in [-1, 1]^3."""

    def parameters(self) -> Mapping[str, mi.Float | mi.TensorXf]:
        """What the optimiser changes."""
        return dict(self.network)

    def attach(self) -> None:
        """Takes over the optimiser's values."""
        self.network.update({key: self.optimizer[key] for key in self.network})

    @property
    def optimizers(self) -> dict[str, mi.ad.Adam]:
        others = {"cubes": self._cubes.optimizer} if self._cubes else {}
        return {"geometry": self.optimizer} | others

    def _begin(self, rate: float) -> None:
        parameters = {name: dr.detach(value) for name, value in self.parameters().items()}
        self.optimizer = mi.ad.Adam(lr=rate, params=parameters)

    def begin(self) -> None:
        self.attach()
        self._begin(self.rate)

    def carry(self, carried: Carried) -> None:
        self.lattice = carried.after
        if self._cubes:
            self._cubes.carry(carried)

    # --- evaluation

    def fields(self) -> dict[str, mi.Float]:
        self.attach()
        count = self.lattice.vertex_count
        fields = {name: dr.empty(mi.Float, CHANNELS[name] * count) for name in self._start}
        last = dr.opaque(mi.UInt32, count - 1)
        with dr.suspend_grad():
            # Piece by piece, as every layer holds a value per vertex and neuron.
            for start in range(0, count, _PIECE):
                vertex = dr.minimum(dr.arange(mi.UInt32, _PIECE) + dr.opaque(mi.UInt32, start), last)
                for name, values in self._at(vertex).items():
                    lane = dr.arange(mi.UInt32, dr.width(values))
                    channel = lane % CHANNELS[name]
                    place = CHANNELS[name] * dr.gather(mi.UInt32, vertex, lane // CHANNELS[name]) + channel
                    dr.scatter(fields[name], values, place)
                dr.eval(fields)
        return fields | (self._cubes.fields() if self._cubes else {})

    def _at(self, vertex: mi.UInt32) -> dict[str, mi.Float]:
        """The three fields at some lattice vertices, attached."""
        sdf, msdf, *offset = self._outputs(mi.Point3f(self.lattice.positions_of(vertex, mi.Float)))
        unit = dr.opaque(mi.Float, _UNIT_CELLS * self.lattice.spacing)
        deform = dr.ravel(dr.clip(mi.Vector3f(*offset), -1, 1))
        fields = {"sdf": unit * sdf, "msdf": unit * msdf, "deform": deform}
        return {name: fields[name] for name in self._start}

    def _outputs(self, points: mi.Point3f) -> list[mi.Float]:
        """What the network says of some points."""
        count = dr.width(points)
        padded = -(-count // _PADDING) * _PADDING
        lane = dr.minimum(dr.arange(mi.UInt32, padded), dr.opaque(mi.UInt32, count - 1))
        points = mi.Point3f(*(dr.gather(mi.Float, coordinate, lane) for coordinate in points))
        out = self.network(self.encode(points)).array
        size = dr.opaque(mi.UInt32, padded)
        index = dr.arange(mi.UInt32, count)
        return [dr.gather(mi.Float, out, index + row * size) for row in range(_OUTPUTS)]

    # --- steps

    def step(
        self,
        gradients: Mapping[str, mi.Float],
        progress: float,
        iteration: int = 0,
        diffuse: LatticeDiffusion | None = None,
    ) -> None:
        own = {name: trusted(gradients[name]) for name in self._start}
        vertex = touched(own, self.lattice.vertex_count)
        if dr.width(vertex):
            self.attach()
            values = self._at(vertex)
            total = sum(
                dr.sum(values[name] * taken(name, gradient, vertex)) for name, gradient in own.items()
            )
            decay = decay_at(progress)
            total += dr.opaque(mi.Float, _EIKONAL_WEIGHT * decay) * self._eikonal(iteration)
            dr.backward(total)
            before = {key: dr.detach(value) for key, value in self.optimizer.items()}
            self._adam_step(self.rate * decay)
            self._limit(before, vertex, dr.detach(values), decay)
        if self._cubes:
            self._cubes.step({"weights": gradients["weights"]}, progress)

    def _limit(
        self, before: Mapping, vertex: mi.UInt32, values: Mapping[str, mi.Float], decay: float
    ) -> None:
        """Shortens the step from ``before`` where it moves the fields too far: a network's parameters say
        nothing of how far that is.

        Args:
            vertex: lattice vertices around the surface.
            values: the fields there before the step.
        """
        self.attach()
        with dr.suspend_grad():
            after = self._at(vertex)
        change = mi.Float(0)
        for name in after.keys() - {"deform"}:
            change = dr.maximum(change, dr.mean(dr.square(after[name] - values[name])))
        moved = dr.sqrt(change) / self.lattice.spacing
        part = dr.minimum(1, dr.opaque(mi.Float, _LARGEST_STEP * self.rules.rate * decay) / moved)
        for key, start in before.items():
            self.optimizer[key] = start + part * (dr.detach(self.optimizer[key]) - start)

    def fit_step(self, iteration: int) -> dict[str, float]:
        """Fits the network to the start at random vertices, three of four of them near the surface."""
        self.attach()
        vertex = self._batch(iteration)
        values = self._at(vertex)
        squares = {
            name: dr.square(values[name] - taken(name, wanted, vertex))
            for name, wanted in self._start.items()
        }
        # Far away only a relative error matters.
        cell, distance = self.lattice.spacing, taken("sdf", self._start["sdf"], vertex)
        importance = dr.rcp(dr.square(cell) + dr.square(0.25 * distance))
        errors = {
            name: dr.mean(square if name == "deform" else importance * square)
            for name, square in squares.items()
        }
        total = mi.Float(sum(errors.values()))
        dr.backward(total)
        self._adam_step(self.fitting_rate * 0.01 ** (iteration / self.fitting_steps))
        return {"loss": total[0]} | {name: error[0] for name, error in errors.items()}

    def _eikonal(self, iteration: int) -> mi.Float:
        """Mean of ``(|grad sdf| - 1)^2`` at random points (Gropp et al. 2020), as in the paper's network.

        Slopes are differences over a cell (Li et al. 2023, "Neuralangelo"): they need no second derivatives,
        and see what the lattice sees.
        """
        lane = dr.arange(mi.UInt32, 4 * _EIKONAL_BATCH)
        seed = dr.opaque(mi.UInt32, iteration) + 65536 * self.seed
        cell = dr.opaque(mi.Float, self.lattice.spacing)
        # Four points in turn: one anywhere, and its neighbours along the axes.
        place, step = lane >> 2, lane & 3
        point = mi.Point3f(*(mi.sample_tea_float32(3 * place + axis, seed) for axis in range(3)))
        point = (2 - cell) * point - 1
        point += mi.Vector3f(*(dr.select(step == axis + 1, cell, 0) for axis in range(3)))
        sdf = _UNIT_CELLS * self._outputs(point)[0]
        values = [dr.gather(mi.Float, sdf, 4 * dr.arange(mi.UInt32, _EIKONAL_BATCH) + i) for i in range(4)]
        slope = dr.sqrt(sum(dr.square(value - values[0]) for value in values[1:]) + 1e-8)
        return dr.mean(dr.square(slope - 1))

    def _adam_step(self, rate: float) -> None:
        self.optimizer.set_learning_rate({key: rate for key in self.optimizer.keys()})
        for key in self.optimizer.keys():
            dr.set_grad(self.optimizer[key], finite(dr.grad(self.optimizer[key])))
        self.optimizer.step()

    def _batch(self, iteration: int) -> mi.UInt32:
        lane = dr.arange(mi.UInt32, _BATCH)
        number, _ = mi.sample_tea_32(lane, dr.opaque(mi.UInt32, iteration) + 65536 * self.seed)
        anywhere = number % dr.opaque(mi.UInt32, self.lattice.vertex_count)
        near = dr.width(self._near)
        if near == 0:
            return anywhere
        beside = dr.gather(mi.UInt32, self._near, number % dr.opaque(mi.UInt32, near))
        return dr.select(lane % 4 == 0, anywhere, beside)


def layers(
    features: int, width: int, hidden: int, activation: type[nn.Module], rng: dr.random.Generator
) -> nn.Sequential:
    """A perceptron with ``hidden`` layers of ``width`` and five linear outputs, with random weights."""
    modules = []
    for _ in range(hidden):
        modules += [nn.Linear(-1, width), activation()]
    return nn.Sequential(*modules, nn.Linear(-1, _OUTPUTS)).alloc(mi.TensorXf, features, rng)


def uniform_weights(linear: nn.Linear, bound: float, rng: np.random.Generator) -> None:
    """Draws the weights of a layer from [-bound, bound], and its biases."""
    shape = linear.weights.shape
    linear.weights = mi.TensorXf(rng.uniform(-bound, bound, shape).astype(np.float32))
    linear.bias = mi.TensorXf(rng.uniform(-bound, bound, shape[0]).astype(np.float32))
