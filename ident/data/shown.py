"""Results that say what was found: in text, in a notebook, in a picture, as a table.

`Shown` is the base of every result of `ident` and `control_design`. It holds no words and no pictures: those
are functions of the package that a user imports (`flexlink`), which is asked for them where it has been
imported. So results need not import it, and nothing about a class changes when it is.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any, ClassVar

# Metadata of a dataclass field that holds what a result was made from: it stays out of files.
NOT_STORED = {"stored": False}


def is_front_door_open() -> bool:
    """Return whether the package `flexlink`, which has words and pictures of results, has been imported."""
    return "flexlink" in sys.modules


def front_door(module: str) -> Any:
    """Return a module of `flexlink`: 'shown', 'pictures' or 'tables'.

    AttributeError where nobody has imported flexlink: this package does not do so by itself.
    """
    if not is_front_door_open():
        raise AttributeError("results are shown, drawn and saved by flexlink: import flexlink")
    return import_module(f"flexlink.{module}")


class Shown:
    """Base of results that are printed, drawn and tabulated by the front door.

    Attributes
    ----------
    table_in_notebook : bool
        A notebook shows the table, where it is short and says more than the sentences.
    """

    table_in_notebook: ClassVar[bool] = False

    def __repr__(self) -> str:
        """The result in sentences; without the front door, as any object prints."""
        if not is_front_door_open():
            return object.__repr__(self)
        return str(front_door("shown").describe(self))

    def _repr_html_(self) -> str:
        """The result as HTML, which notebooks ask for by this name; AttributeError without front door."""
        return str(front_door("shown").html_text(self))

    def plot(self) -> Any:
        """Draw the result; see `flexlink.plot`, which raises what it raises (`front_door`)."""
        return front_door("pictures").plot(self)

    def table(self) -> Any:
        """Return the result as a `pandas.DataFrame`; see `flexlink.table` (`front_door`)."""
        return front_door("tables").table(self)
