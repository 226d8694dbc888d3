"""Results that say what was found: in text, in a notebook, in a picture, as a table."""

from __future__ import annotations

from typing import Any, ClassVar

# Of a field for what a result was made from: it stays out of files.
NOT_STORED = {"stored": False}


class Shown:
    """Base of results. Words and pictures are the front door's: `flexlink` puts itself here as `front` with
    the first name that is asked of it; before, a result prints as any object."""

    front: ClassVar[Any] = None
    table_in_notebook: ClassVar[bool] = False  # where it is short, and says more than the sentences

    def __repr__(self) -> str:
        return object.__repr__(self) if self.front is None else str(self.front.shown.text(self))

    def _repr_html_(self) -> str:
        return str(self.front.shown.html_text(self))

    def plot(self) -> Any:
        """Draw the result; see `flexlink.plot`."""
        return self.front.plot(self)

    def table(self) -> Any:
        """Return the result as a `pandas.DataFrame`; see `flexlink.table`."""
        return self.front.table(self)
