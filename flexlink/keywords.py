"""Keywords that a function does not take are refused in one line that says what was meant."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

from ident.data.settings import Settings, meant

F = TypeVar("F", bound=Callable[..., Any])


class UnknownKeywordError(ValueError, TypeError):
    """A keyword that a function does not take; one line that says what was meant, or where it belongs."""


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
