"""Registration of the plugin files with Mitsuba, once per variant.

The base classes of a plugin (``mi.ad.common.ADIntegrator``, ``mi.Emitter``, ...) are different classes in every
variant, so a plugin file is executed once for each variant that is used. Every execution gets a module of its own:
classes and objects of one variant go on working after a change to another. ``rimlight.integrators.direct_edge``, in
`sys.modules` and as an attribute, is the module of the current variant.

This state must survive a reload of the package `rimlight`, which Mitsuba >= 3.10 does at every change of the variant.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from types import ModuleType

import mitsuba as mi

#: Their modules are plugin files, but for names with a leading underscore.
PLUGINS = ("rimlight.bsdfs", "rimlight.emitters", "rimlight.integrators", "rimlight.sensors")

#: Modules that are executed for each variant: plugin files, and what their base classes are made of. Dr.Jit remembers
#: the types of the fields of a data class, which differ between variants.
PACKAGES = (*PLUGINS, "rimlight.terms", "rimlight.transport")

_modules: dict[str, dict[str, ModuleType]] = {}  # variant -> full name -> module


def plugin_modules(variant: str) -> dict[str, ModuleType]:
    """Full names and modules of the plugin files that are registered for `variant`, helper modules included."""
    return dict(_modules.get(variant, {}))


def register() -> None:
    """Register every plugin for the current variant. Does nothing without a variant, or a second time for the same.

    Variants without automatic differentiation (``scalar_rgb``) have none of the base classes; they are left alone.
    """
    variant = mi.variant()
    if variant is None or "_ad_" not in variant:
        return
    if variant in _modules:
        _expose(_modules[variant])
        return

    _expose({})
    try:
        for package_name in PLUGINS:
            package = importlib.import_module(package_name)
            for module in pkgutil.iter_modules(package.__path__, package_name + "."):
                if not module.name.rpartition(".")[2].startswith("_"):
                    importlib.import_module(module.name)
    except BaseException:
        _expose({})  # the next attempt starts afresh
        raise
    _modules[variant] = {name: sys.modules[name] for name in _plugin_names()}


def follow_variants() -> None:
    """Register now, and after every change of the variant. Calling it again changes nothing."""
    mi.detail.add_variant_callback(_on_variant)
    register()


def _on_variant(_old: str | None, _new: str) -> None:
    register()


def _plugin_names() -> list[str]:
    return [name for name in sys.modules if name.rpartition(".")[0] in PACKAGES]


def _expose(modules: dict[str, ModuleType]) -> None:
    """Make `modules` the ones, and the only ones, that an import of a plugin file finds."""
    for name in _plugin_names():
        del sys.modules[name]
        parent, _, child = name.rpartition(".")
        if parent in sys.modules:
            vars(sys.modules[parent]).pop(child, None)
    for name, module in modules.items():
        sys.modules[name] = module
        parent, _, child = name.rpartition(".")
        setattr(sys.modules[parent], child, module)
