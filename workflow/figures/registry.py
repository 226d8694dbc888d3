"""Drawings by name: a template says `figure("nyquist", run)`, and the function that is called so draws it."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from functools import cache
from typing import TypeVar

from matplotlib.figure import Figure

from workflow.figures.style import house_style

Drawing = Callable[..., Figure | None]
D = TypeVar("D", bound=Drawing)

_DRAWINGS: dict[str, Drawing] = {}


def drawing(name: str) -> Callable[[D], D]:
    """Give a drawing its name on the pages, and the house style.

    It takes typed results; None means there is nothing to draw.
    """

    def register(draw: D) -> D:
        if name in _DRAWINGS:
            raise ValueError(f"two drawings are called {name!r}")
        styled: D = house_style()(draw)
        _DRAWINGS[name] = styled
        return styled

    return register


@cache
def drawings() -> Mapping[str, Drawing]:
    """Every drawing of every module of this package, so that a new one is named in its own file only."""
    package = importlib.import_module("workflow.figures")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"workflow.figures.{module.name}")
    return _DRAWINGS
