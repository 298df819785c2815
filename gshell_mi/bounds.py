"""Bounds of settings, declared at the field and checked in one place."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from .errors import UserError


@dataclass(frozen=True)
class Between:
    """Least and greatest sensible value of a number: ``Annotated[float, Between(0, 1)]``.

    A number without one is at least 0.
    """

    least: float = 0
    most: float = math.inf


def check_bounds(config: Any) -> None:
    """Checks every number of a settings dataclass and of those nested in it.

    Raises:
        UserError: a number is not finite or out of its bounds; the sentence has the flag's name.
    """
    for name, value, declared in leaves(config):
        if isinstance(value, dict):
            for key, number in value.items():
                _check(f"{flag_of(name)} {key}", number)
        elif not isinstance(value, str | bool | None):
            bounds = [one for one in declared if isinstance(one, Between)]
            _check(flag_of(name), value, *bounds[:1])


def _check(flag: str, value: float, bounds: Between = Between()) -> None:
    if not math.isfinite(value):
        raise UserError(f"{flag} must be a finite number, not {value}.")
    if value < bounds.least:
        raise UserError(f"{flag} must be at least {bounds.least}, not {value}.")
    if value > bounds.most:
        raise UserError(f"{flag} must be at most {bounds.most}, not {value}.")


def leaves(config: Any, prefix: str = "") -> Iterator[tuple[str, Any, tuple]]:
    """Name (``stage.setting``), value and annotations of every setting, nested ones included."""
    types = typing.get_type_hints(type(config), include_extras=True)
    for field in dataclasses.fields(config):
        name, value = prefix + field.name, getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{name}.")
        else:
            yield name, value, getattr(types[field.name], "__metadata__", ())


def flag_of(name: str) -> str:
    """The option that gives a setting.

    >>> flag_of("joint.geometry_lr")
    '--joint.geometry-lr'
    """
    return f"--{name.replace('_', '-')}"
