"""Results that say what was found: in text, in a notebook, in a picture, as a table.

`Shown` is the base of every result of `ident` and `control_design`. It holds no words and no pictures: these
are made by the package that a user imports (`flexlink`), which puts itself here when it is loaded, so that
results need not import it.
"""

from __future__ import annotations

from typing import Any, ClassVar

# Metadata of a dataclass field that holds what a result was made from: it stays out of files.
NOT_STORED = {"stored": False}


class Shown:
    """Base of results that are printed, drawn and tabulated by the front door.

    Attributes
    ----------
    front : module or None
        `flexlink`, which puts itself here with the first name that is asked of it. Before, a result prints
        as any object.
    table_in_notebook : bool
        A notebook shows the table, where it is short and says more than the sentences.
    """

    front: ClassVar[Any] = None
    table_in_notebook: ClassVar[bool] = False

    def __repr__(self) -> str:
        """The result in sentences; without the front door, as any object prints."""
        if self.front is None:
            return object.__repr__(self)
        return str(self.front.shown.text(self))

    def _repr_html_(self) -> str:
        """The result as HTML, which notebooks ask for by this name.

        AttributeError where the front door is not loaded.
        """
        return str(self.front.shown.html_text(self))

    def plot(self) -> Any:
        """Draw the result; see `flexlink.plot`.

        AttributeError where the front door is not loaded; else what it raises.
        """
        return self.front.plot(self)

    def table(self) -> Any:
        """Return the result as a `pandas.DataFrame`; see `flexlink.table`.

        AttributeError where the front door is not loaded; else what it raises.
        """
        return self.front.table(self)
