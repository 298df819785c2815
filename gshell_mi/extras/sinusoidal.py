"""Fields from a network with sine activations."""

from __future__ import annotations

from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit import nn

from ..arrays import ArrayT
from .network import NetworkFields, layers, uniform_weights

#: Angular frequency of the activations, in radians per unit of their input.
_FREQUENCY = 30.0
_WIDTH, _HIDDEN = 64, 3


class Sine(nn.Module):
    """``sin(30 x)``, the activation of SIREN (Sitzmann et al. 2020, "Implicit Neural Representations with
    Periodic Activation Functions")."""

    DRJIT_STRUCT: ClassVar[dict] = {}

    def __call__(self, arg: ArrayT) -> ArrayT:
        return dr.sin(_FREQUENCY * arg)


class SinusoidalNetwork(NetworkFields):
    """SIREN (``sinusoidal``): the position goes straight into a perceptron with sine activations.

    The initial weights are those of the paper (sec. 3.2), with which each layer's input to the sine is
    about normally distributed.
    """

    fitting_steps = 800
    fitting_rate = 1e-3
    rate = 1e-4

    def make_network(self, rng: dr.random.Generator) -> nn.Module:
        network = layers(3, _WIDTH, _HIDDEN, Sine, rng)
        weights = np.random.default_rng(self.seed)
        linear = [layer for layer in network.layers if isinstance(layer, nn.Linear)]
        uniform_weights(linear[0], 1 / 3, weights)
        for layer in linear[1:]:
            uniform_weights(layer, (6 / layer.weights.shape[1]) ** 0.5 / _FREQUENCY, weights)
        return network

    def encode(self, points: mi.Point3f) -> mi.TensorXf:
        return mi.TensorXf(dr.ravel(points, order="C"), (3, dr.width(points)))
