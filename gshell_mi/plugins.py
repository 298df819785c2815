"""Registration of the Mitsuba plugins of this package for the variant in use.

Python plugins derive from classes that exist once per variant (``mi.Mesh``,
``mi.ad.integrators.common.ADIntegrator``), so a module that defines one is loaded when a variant
is set and loaded anew when it changes, as Mitsuba does with its own Python integrators.
"""

import importlib
import sys

import mitsuba as mi

from .compat import trust_only_own_plugins

#: Modules that define a plugin class at import and register it with Mitsuba.
PLUGIN_MODULES = ("gshell_mi.shape", "gshell_mi.integrators.gshell_path", "gshell_mi.integrators.gshell_mask")

_registered_variant: str | None = None


def register() -> None:
    """Registers every plugin for ``mi.variant()``; does nothing without a variant or twice for one.

    Scalar variants are left alone: the package is written in Dr.Jit arrays and has no meaning there.
    """
    global _registered_variant
    variant = mi.variant()
    if variant is None or variant.startswith("scalar") or variant == _registered_variant:
        return
    for name in PLUGIN_MODULES:
        if name in sys.modules:
            importlib.reload(sys.modules[name])
        else:
            importlib.import_module(name)
    _registered_variant = variant


def register_on_variant_change() -> None:
    """Registers now if a variant is set, and again whenever it changes."""
    trust_only_own_plugins()
    mi.detail.add_variant_callback(lambda old, new: register())
    register()
