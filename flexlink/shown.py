"""Results that say what was found: in text, in a notebook, in a picture."""

from __future__ import annotations

import html
from dataclasses import fields
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

T = TypeVar("T")


class Shown:
    """Put before the class of a result: the sentences are the macro of the same name in results.j2."""

    table_in_notebook: ClassVar[bool] = False  # where it is short, and says more than the sentences

    def __repr__(self) -> str:
        return "\n".join(_lines(self))

    def _repr_html_(self) -> str:
        first, *others = (html.escape(line.strip()) for line in _lines(self))
        said = f"<p>{'<br>'.join([f'<b>{first}</b>', *others])}</p>"
        if not self.table_in_notebook:
            return said
        return said + self.table().to_html(index=False, na_rep="", float_format="{:.4g}".format, border=0)

    def plot(self) -> Figure:
        """Draw the result; see `flexlink.plot`."""
        from flexlink import plot

        return plot(self)

    def table(self) -> pd.DataFrame:
        """Return the result as a table; see `flexlink.table`."""
        from flexlink import table

        return table(self)


def dressed(kind: type[T], value: Any, **more: Any) -> T:
    """A numerical result as the class of the front door that shows itself; the fields are the same."""
    return kind(**{field.name: getattr(value, field.name) for field in fields(value)} | more)


def _lines(result: object) -> list[str]:
    text = str(getattr(_macros(), type(result).__name__)(result))
    return [line.rstrip() for line in text.splitlines() if line.strip()]


@cache
def _macros() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    from workflow.diagnose.words import times_noise
    from workflow.text.formats import at_least, at_most, bound, listing
    from workflow.text.templates import words

    # Text; the HTML is escaped line by line.
    loader = PackageLoader("flexlink")
    environment = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"words": words, "at_least": at_least, "at_most": at_most, "bound": bound}
    environment.filters |= {"listing": listing, "times_noise": times_noise}
    environment.globals |= {"zip": zip, "abs": abs}
    return environment.get_template("results.j2").module
