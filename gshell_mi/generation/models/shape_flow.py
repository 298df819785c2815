"""Flow matching on whole shapes: each is a point in the space of a set's leading principal components.

The pair of fields is written as a cubic spline on a coarser grid, the principal components of which follow
from a set at once, and a perceptron learns how shapes lie in their space: a laptop does both in minutes. Flow
matching is that of Lipman et al. (ICLR 2023), with straight paths from noise at t = 0 to data at t = 1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy import ndimage
from scipy.sparse.linalg import eigsh
from torch import Tensor, nn

from ..fields import TRUNCATION_CELLS
from ..model_config import ModelConfig
from .coded_set import CodedSet
from .flow import Velocity, blended, guided, integrated, start_of
from .perceptron import Perceptron
from .steering import Steering
from .training_set import TrainingSet

_DROPOUT = 0.1
#: Nodes per side of the spline, at most.
_NODES = 32
#: Objects per step, for each of ``--batch``: a step costs next to nothing.
_MORE = 2
#: Caps are pushed outwards by so many cells per cell beyond a rim, from the second number on to the third:
#: a sheet close to its cap would be a thin wedge, which sums of shapes tear. Where a cap is nobody sees.
_PUSH, _PUSHED_FROM, _PUSHED_TO = 2.0, 0.3, 3.3
#: Trust in what is known of a shape: this variance per node, by the truncation.
_KNOWN_VARIANCE = 1e-4
#: Levels of a stored component.
_LEVELS = 127
#: Fields that are looked at at once.
_CHUNK = 16


class ShapeFlow(nn.Module):
    """Principal components of whole shapes, and a perceptron that turns noise into points among them."""

    #: What is trained, and its share of the time.
    stages = (("flow", 1.0),)

    mean: Tensor
    basis: Tensor
    scale: Tensor
    weight: Tensor
    spline: Tensor
    fit: Tensor

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        shape = config.shape
        self.nodes = min(_NODES, config.side)
        self.components = shape.components
        self.flow = Perceptron(
            shape.components, len(config.classes), shape.perceptron, shape.layers, _DROPOUT
        )
        values = 2 * self.nodes**3
        self.register_buffer("mean", torch.zeros(values))
        self.register_buffer("basis", torch.zeros((shape.components, values), dtype=torch.int8))
        self.register_buffer("scale", torch.zeros(shape.components))
        self.register_buffer("weight", torch.ones(shape.components))
        at = np.linspace(0, self.nodes - 1, config.side)
        spline = np.stack(
            [ndimage.map_coordinates(row, [at], order=3, mode="nearest") for row in np.eye(self.nodes)],
            axis=1,
        )
        self.register_buffer("spline", torch.from_numpy(spline).float(), persistent=False)
        self.register_buffer("fit", torch.from_numpy(np.linalg.pinv(spline)).float(), persistent=False)

    # -- training -------------------------------------------------------------------------------------

    def part(self, stage: str) -> nn.Module:
        """What a stage trains."""
        return self.flow

    def rate(self, stage: str, rate: float) -> float:
        """A stage's learning rate."""
        return rate

    def batch_size(self, stage: str, batch: int) -> int:
        """Objects per step of a stage."""
        return _MORE * batch

    @torch.no_grad()
    def prepare(self, stage: str, data: TrainingSet) -> CodedSet:
        """A set as points; the first one gives the components."""
        device = self.mean.device
        nodes = torch.cat([self._to_nodes(part) for part in data.parts(_CHUNK, device)])
        found = bool(self.scale.any())
        if not found:
            self.mean.copy_(nodes.mean(dim=0).half())  # as it is stored
        nodes -= self.mean
        if not found:
            self._find_components(nodes)
        return CodedSet(nodes @ self._inverse(), data.kinds.to(device))

    def _find_components(self, centred: Tensor) -> None:
        # Of few objects by their products, n x n, not by those of tens of thousands of nodes.
        kept = min(self.components, len(centred) - 1)
        vectors = leading_eigenvectors((centred @ centred.T).double().cpu().numpy(), kept)
        leading = torch.from_numpy(np.ascontiguousarray(vectors.T)).to(centred)
        found = leading @ centred  # (kept, values), not normalised
        found = found / found.norm(dim=1, keepdim=True)
        deviation = (centred @ found.T).square().mean(dim=0).sqrt()
        found = found * deviation[:, None]
        self.weight.zero_()
        self.weight[:kept] = deviation / deviation.mean()
        step = found.abs().amax(dim=1) / _LEVELS
        self.scale[:kept] = step.half().float()
        levels = torch.round(found / self.scale[:kept, None]).clamp(-_LEVELS, _LEVELS)
        self.basis[:kept] = levels.to(torch.int8)

    def _basis(self) -> Tensor:
        """(components, values): a unit of a component is its deviation over the set."""
        return self.basis.float() * self.scale[:, None]

    def _inverse(self) -> Tensor:
        """(values, components), orthogonal but for rounding."""
        basis = self._basis()
        return (basis / basis.square().sum(dim=1, keepdim=True).clamp(min=1e-12)).T

    def draw(
        self, stage: str, data: CodedSet, chosen: Tensor, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """A batch of the rows ``chosen``, with all its chance, on the generator's device."""
        return data.draw(chosen, len(self.config.classes), generator)

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        """The mean squared error of the velocity. Components count as much as they stretch over the set."""
        x, noise, at = batch["x"], batch["noise"], batch["t"][:, None]
        found = self.flow((1 - at) * noise + at * x, batch["t"], batch["kinds"])
        return (self.weight * (found.float() - (x - noise)).square()).mean()

    def coded(self, fields: Tensor) -> tuple[Tensor, int]:
        """Fields after a way through the components, and the numbers of each."""
        return self._fields(self._coded(fields)).clamp(-1, 1), self.components

    # -- sampling -------------------------------------------------------------------------------------

    @torch.no_grad()
    def sample(self, steering: Steering, told: Callable[[], None] = lambda: None) -> np.ndarray:
        """(B, 2, N, N, N) float32 truncated fields.

        What the components lose of ``steering.start`` is given back to the part that is kept of it.

        Args:
            told: called after each of ``steering.steps``.
        """
        device = self.mean.device
        noise = steering.noise((self.components,)).to(device)
        velocity = guided(self.flow, steering, len(self.config.classes), device)
        start = start_of(steering, device)
        goal = None if start is None else self._coded(start)
        if start is not None and steering.known is not None:
            velocity = _toward(self._conditioned(start, steering.known), velocity)
        points = integrated(velocity, noise, goal, steering, told)
        return blended(self._fields, points, steering, start, goal)

    def _conditioned(self, start: Tensor, known: np.ndarray) -> Callable[[Tensor], Tensor]:
        """Points moved so that their shapes have the known nodes of ``start``, as far as that is likely where
        points are normally distributed."""
        at = np.round(np.linspace(0, self.config.side - 1, self.nodes)).astype(int)
        mask = torch.from_numpy(known[np.ix_(at, at, at)].ravel()).to(start.device).repeat(2)
        there = self._basis()[:, mask]
        true = (self._to_nodes(start) - self.mean)[:, mask]
        matrix = there @ there.T + _KNOWN_VARIANCE * torch.eye(self.components, device=start.device)

        def toward(x: Tensor) -> Tensor:
            return x + torch.linalg.solve(matrix, there @ (true - x @ there).T).T

        return toward

    # -- fields and nodes -----------------------------------------------------------------------------

    def _to_nodes(self, fields: Tensor) -> Tensor:
        """(B, 2, N, N, N) truncated fields as (B, values) nodes of splines."""
        sdf, msdf = fields.unbind(dim=1)
        beyond = (-msdf * TRUNCATION_CELLS).clamp(_PUSHED_FROM, _PUSHED_TO) - _PUSHED_FROM
        pushed = (sdf - _PUSH / TRUNCATION_CELLS * beyond).clamp(min=-1)
        return self._along_axes(self.fit, torch.stack([pushed, msdf], dim=1)).flatten(1)

    def _coded(self, fields: Tensor) -> Tensor:
        """(B, 2, N, N, N) fields as (B, components) points."""
        return (self._to_nodes(fields) - self.mean) @ self._inverse()

    def _fields(self, points: Tensor) -> Tensor:
        nodes = points @ self._basis() + self.mean
        return self._along_axes(self.spline, nodes.view(-1, 2, *3 * (self.nodes,)))

    @staticmethod
    def _along_axes(matrix: Tensor, values: Tensor) -> Tensor:
        for _ in range(3):  # each turn the last axis becomes the first of the three
            values = (values @ matrix.T).permute(0, 1, 4, 2, 3)
        return values.contiguous()


def _toward(conditioned: Callable[[Tensor], Tensor], velocity: Velocity) -> Velocity:
    """A velocity that leads to what is known, of what it would lead to."""
    return lambda x, t: (conditioned(x + (1 - t) * velocity(x, t)) - x) / (1 - t)


def leading_eigenvectors(matrix: np.ndarray, count: int) -> np.ndarray:
    """(n, count): unit eigenvectors of a symmetric (n, n) matrix without negative eigenvalues, those of the
    largest first. The same matrix has the same ones.

    >>> leading_eigenvectors(np.diag([1.0, 3.0, 2.0]), 2).round(6).__abs__()
    array([[0., 0.],
           [1., 0.],
           [0., 1.]])
    """
    if 4 * count > len(matrix):
        # Lanczos' method would find all there is, and go on from random vectors.
        return np.linalg.eigh(matrix)[1][:, ::-1][:, :count]
    begin = np.random.default_rng(0).normal(size=len(matrix))
    return eigsh(matrix, count, v0=begin)[1][:, ::-1]
