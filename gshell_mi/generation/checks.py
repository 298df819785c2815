"""Arguments that the commands check alike."""

from __future__ import annotations

import math

from ..errors import UserError


def check_choice(option: str, value: str, choices: tuple[str, ...]) -> None:
    """Raises ``UserError`` if the value is none of the choices."""
    if value not in choices:
        raise UserError(f"{option} '{value}' is not known; choose one of {', '.join(choices)}.")


def check_positive(option: str, value: float) -> None:
    """Raises ``UserError`` if the value is not a number above 0."""
    if not (value > 0 and math.isfinite(value)):
        raise UserError(f"{option} must be more than 0, not {value:g}.")
