"""Fields from a hash grid and a small network."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
from drjit import nn

from .network import NetworkFields, layers

_LEVELS, _FEATURES = 6, 2
_COARSEST = 8
_TABLE = 1 << 17
_WIDTH, _HIDDEN = 32, 1


class HashGridNetwork(NetworkFields):
    """Dr.Jit's multi-resolution hash grid and a small perceptron (``hashgrid``; Müller et al. 2022, "Instant
    Neural Graphics Primitives").

    The finest level of the encoding has the lattice's own cells; finer ones would be noise to it.
    """

    fitting_steps = 600
    fitting_rate = 1e-2
    rate = 1e-3

    def make_network(self, rng: dr.random.Generator) -> nn.Module:
        finest = max(self.lattice.resolution, _COARSEST + 1)
        self._encoding = nn.HashGridEncoding(
            mi.Float,
            3,
            n_levels=_LEVELS,
            n_features_per_level=_FEATURES,
            hashmap_size=_TABLE,
            base_resolution=_COARSEST,
            per_level_scale=(finest / _COARSEST) ** (1 / (_LEVELS - 1)),
            align_corners=True,
            rng=rng,
        )
        return layers(_LEVELS * _FEATURES, _WIDTH, _HIDDEN, nn.ReLU, rng)

    def parameters(self) -> Mapping[str, mi.Float | mi.TensorXf]:
        return {"table": self._encoding.data} | dict(super().parameters())

    def attach(self) -> None:
        super().attach()
        self._encoding.data = self.optimizer["table"]

    def encode(self, points: mi.Point3f) -> mi.TensorXf:
        features = mi.ArrayXf(self._encoding(0.5 * (points + 1)))
        return mi.TensorXf(dr.ravel(features, order="C"), (len(features), dr.width(points)))
