"""The state of an Adam optimiser as host arrays, and back."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

from .errors import UserError


def optimizer_arrays(name: str, optimizer: mi.ad.Adam) -> dict[str, np.ndarray]:
    """The values, moments and step counts of an Adam optimiser, as host arrays."""
    arrays = {}
    for key, (value, _, _, (step, first, second, _)) in optimizer.state.items():
        for part, array in (("value", value), ("step", step), ("first", first), ("second", second)):
            arrays[f"{name}/{key}/{part}"] = np.array(dr.detach(array))
    return arrays


def restore_optimizer(name: str, optimizer: mi.ad.Adam, arrays: Mapping[str, np.ndarray]) -> None:
    """Puts back what ``optimizer_arrays`` saved into an optimiser with the same parameters.

    Raises:
        UserError: the sizes are others.
    """
    for key, (value, promoted, rate, (step, first, second, maximum)) in list(optimizer.state.items()):
        stored = {part: arrays[f"{name}/{key}/{part}"] for part in ("value", "step", "first", "second")}
        if any(
            stored[part].shape != now.shape
            for part, now in (("value", value), ("step", step), ("first", first), ("second", second))
        ):
            raise UserError(
                f"The checkpoint's '{name}/{key}' has another size than this fit needs; start "
                f"again with --overwrite."
            )
        restored = type(value)(stored["value"])
        dr.enable_grad(restored)
        step, first, second = (
            type(old)(stored[part]) for old, part in ((step, "step"), (first, "first"), (second, "second"))
        )
        optimizer.state[key] = (restored, promoted, rate, (step, first, second, maximum))
