"""The packages behind flexlink have short names: a file `plant.py` of the user's own, in the current folder,
beside a script or on PYTHONPATH, does not take the place of ours."""

from __future__ import annotations

import os
import sys
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any

# Packages of this distribution, which a file of the user's own may have the name of.
NAMES = ("plant", "ident", "control_design", "diagnosis", "workflow", "validation")
# The folder in which they stand beside this one.
_ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


class _OwnPackages:
    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        return PathFinder.find_spec(name, [_ROOT]) if path is None and name in NAMES else None


def find_own_first() -> None:
    """From here on these names mean our packages, in this process. Raises ImportError where another module
    has been imported under one of them already."""
    for name in NAMES:
        file = getattr(sys.modules.get(name), "__file__", None)
        if file is not None and os.path.dirname(os.path.dirname(os.path.abspath(file))) != _ROOT:
            raise ImportError(
                f"{file} was imported as {name!r}, the name of a package of flexlink: rename the file"
            )
    # Before Python's own finders, which look into the current folder first.
    if _OwnPackages not in sys.meta_path:
        sys.meta_path.insert(0, _OwnPackages)
