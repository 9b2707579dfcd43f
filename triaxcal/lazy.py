"""Public names of a package, each loaded when it is first used: most commands
need only a part of the metrology, and no scipy to show their help."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def lazily(package: str, names: Mapping[str, Sequence[str]], modules: Sequence[str] = ()) -> Callable[[str], Any]:
    """A ``__getattr__`` for ``package``: ``names`` by the module of the package
    that defines them, and ``modules`` that are public as a whole."""
    where = {name: module for module, listed in names.items() for name in listed}

    def find(name: str) -> Any:
        if name in modules:
            return import_module(f"{package}.{name}")
        if name not in where:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        found = getattr(import_module(f"{package}.{where[name]}"), name)
        setattr(sys.modules[package], name, found)  # not asked for again
        return found

    return find
