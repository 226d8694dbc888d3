"""Results that say what was found: in text, in a notebook, in a picture."""

from __future__ import annotations

import html
import inspect
import re
import sys
from collections.abc import Callable
from dataclasses import fields
from functools import cache, wraps
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from ident.data.settings import Settings, meant

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


class UnknownKeywordError(ValueError, TypeError):
    """A keyword that a function does not take; one line that says what was meant, or where it belongs."""


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


def one_line(function: F) -> F:
    """The function, which refuses a keyword that nobody knows as settings refuse a key."""

    @wraps(function)
    def called(*arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        except TypeError as error:
            unknown = re.search(r"unexpected keyword argument '(\w+)'", str(error))
            if unknown is None or unknown[1] not in named:
                raise
            name, of = unknown[1], function.__qualname__.removesuffix(".__init__")
        own = inspect.signature(function).parameters.values()
        known = [
            each.name
            for each in own
            if each.kind is not each.VAR_KEYWORD and each.name not in ("self", "cls")
        ]
        where = meant(name, known, "keywords")
        if len(known) < len(own) and "did you mean" not in where:
            where += f", more in help(flexlink.{of})"
        hints = " ".join(str(each.annotation) for each in own)
        for kind in vars(sys.modules[function.__module__]).values():
            settings = inspect.isclass(kind) and issubclass(kind, Settings) and kind.__name__ in hints
            if settings and name in kind.model_fields:
                where = f"a field of flexlink.{kind.__name__}({name}=...)"
        raise UnknownKeywordError(f"{of}: unknown keyword {name} ({where})")

    return called  # type: ignore[return-value]


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
