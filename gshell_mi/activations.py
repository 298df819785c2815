"""Functions from all numbers to those in a range, for what is optimised without bounds."""

from __future__ import annotations

import drjit as dr
import numpy as np

from .arrays import ArrayT


def sigmoid(x: ArrayT) -> ArrayT:
    """``1 / (1 + exp(-x))``, in (0, 1), of a Dr.Jit array.

    >>> import mitsuba as mi
    >>> f"{sigmoid(mi.Float(np.log(3)))[0]:.4f}"
    '0.7500'
    """
    return dr.rcp(1 + dr.exp(-x))


def softplus(x: ArrayT) -> ArrayT:
    """``log(1 + exp(x))``, positive, of a Dr.Jit array; never overflows.

    >>> import mitsuba as mi
    >>> [f"{y:.4f}" for y in softplus(mi.Float(0, 500))]
    ['0.6931', '500.0000']
    """
    return dr.maximum(x, 0) + dr.log(1 + dr.exp(-dr.abs(x)))


def inverse_softplus(y: float) -> float:
    """The number whose softplus is ``y``, where a smaller ``y`` counts as 0.001.

    >>> import mitsuba as mi
    >>> f"{softplus(mi.Float(inverse_softplus(0.3)))[0]:.4f}"
    '0.3000'
    """
    return float(np.log(np.expm1(max(y, 1e-3))))
