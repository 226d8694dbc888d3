"""Drawings by name: a template says `figure("nyquist", run)`, and the function that is called so draws it."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from functools import cache

from workflow.figures.style import D, Drawing, finished

_DRAWINGS: dict[str, Drawing] = {}


def drawing(name: str) -> Callable[[D], D]:
    """Give a drawing its name on the pages; it is `finished`.

    It takes typed results; None means there is nothing to draw.
    """

    def register(draw: D) -> D:
        if name in _DRAWINGS:
            raise ValueError(f"two drawings are called {name!r}")
        _DRAWINGS[name] = done = finished(draw)
        return done

    return register


@cache
def drawings() -> Mapping[str, Drawing]:
    """Every drawing of every module of this package, so that a new one is named in its own file only."""
    package = importlib.import_module("workflow.figures")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"workflow.figures.{module.name}")
    return _DRAWINGS
