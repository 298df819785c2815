"""Settings of a fit as text."""

from __future__ import annotations

import json

from gshell_mi.errors import UserError
from gshell_mi.fit import FitConfig

#: Types of the settings whose default is None.
_OPTIONAL = {"resolution": int, "grid": str, "refinement.descent": float, "folds.descent": float}


def parsed_settings(pairs: list[str]) -> FitConfig:
    """The configuration that ``["resolution=48", "losses.image=l1"]`` stands for; the rest are defaults.

    Raises:
        UserError: no such setting, or a value of another kind than its default.
    """
    defaults, given = FitConfig().settings(), {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        if name not in defaults:
            raise UserError(f"There is no setting '{name}'; python -m gshell_mi.fit --help lists them.")
        try:
            value = json.loads(text)
        except ValueError:
            value = text
        kind = _OPTIONAL.get(name, type(defaults[name]))
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind:
            raise UserError(f"The setting '{name}' is a {kind.__name__}, and '{text}' is none.")
        given[name] = value
    return FitConfig().changed(given)


def as_flags(changes: dict) -> str:
    """Settings as the options of ``python -m gshell_mi.fit``.

    >>> as_flags({"openings.mask": 0.0, "watertight": True, "losses.extra": {"eikonal": 0.5}})
    '--openings.mask 0 --watertight --losses.extra eikonal 0.5'
    """
    words = []
    for name, value in changes.items():
        flag = f"--{name.replace('_', '-')}"
        if isinstance(value, dict):
            value = " ".join(f"{key} {number:g}" for key, number in value.items())
        words.append(
            flag if value is True else f"{flag} {value:g}" if isinstance(value, float) else f"{flag} {value}"
        )
    return " ".join(words)


def non_default(config: FitConfig) -> dict:
    """The settings that are not defaults."""
    defaults = FitConfig().settings()
    return {name: value for name, value in config.settings().items() if value != defaults[name]}
