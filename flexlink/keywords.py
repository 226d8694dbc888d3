"""What a function of the front door does not take is refused in one line that says what was meant."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from functools import wraps
from typing import Any, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from ident.data.settings import Settings, meant

F = TypeVar("F", bound=Callable[..., Any])
Options = TypeVar("Options", bound=Settings)


class WrongArgumentError(ValueError, TypeError):
    """A keyword or a system that has no place here; one line that says what to do."""


def one_line(function: F) -> F:
    """The function on one BLAS thread, as the commands run (but for an `__init__`, which is quick). It
    refuses a keyword that nobody knows as settings refuse a key."""

    own = inspect.signature(function).parameters

    @wraps(function)
    def called(*arguments: Any, **named: Any) -> Any:
        refuse_rate(named.get("dt_s", dict(zip(own, arguments, strict=False)).get("dt_s")))
        try:
            with nullcontext() if function.__name__ == "__init__" else threadpool_limits(1):
                return function(*arguments, **named)
        except TypeError as error:
            of = function.__qualname__.removesuffix(".__init__")
            unknown = re.search(r"unexpected keyword argument '(\w+)'", str(error))
            if re.search(rf"\b{function.__name__}[(][)] (takes|missing)", str(error)):
                takes = _call_of(own.values())
                signals = any(isinstance(each, np.ndarray) for each in arguments)
                hint = "; signals are one argument: flexlink.Record(u=u, y=y, dt_s=dt_s)" if signals else ""
                raise WrongArgumentError(f"{of}: expected {of}({takes}){hint}") from None
            if unknown is None or unknown[1] not in named:
                raise
            name = unknown[1]
        known = [each.name for each in own.values() if each.kind is not each.VAR_KEYWORD]
        where = meant(name, [each for each in known if each not in ("self", "cls")], "keywords")
        if len(known) < len(own) and "did you mean" not in where:
            where += f", more in help(flexlink.{of})"
        hints = " ".join(str(each.annotation) for each in own.values())
        for kind in vars(sys.modules[function.__module__]).values():
            settings = inspect.isclass(kind) and issubclass(kind, Settings) and kind.__name__ in hints
            if settings and name in kind.model_fields:
                where = f"a field of flexlink.{kind.__name__}({name}=...)"
        raise WrongArgumentError(f"{of}: unknown keyword {name} ({where})")

    return called  # type: ignore[return-value]


def _call_of(parameters: Iterable[inspect.Parameter]) -> str:
    """How a function is called: names of what may stand by itself, NAME=... of what needs its keyword."""
    parts = []
    for parameter in parameters:
        if parameter.name in ("self", "cls"):
            continue
        if parameter.kind is parameter.VAR_POSITIONAL:
            parts.append(f"*{parameter.name}")
        elif parameter.kind is parameter.VAR_KEYWORD:
            parts.append("...")
        elif parameter.kind is parameter.KEYWORD_ONLY:
            parts.append(f"{parameter.name}=...")
        else:
            parts.append(parameter.name)
    return ", ".join(parts)


def refuse_rate(dt_s: Any, slowest_s: float = 20.0) -> None:
    """Raises ValueError for a sampling time that is rather a rate in Hz: no machine is sampled that slowly,
    and few are at fewer Hz."""
    if isinstance(dt_s, (int, float, np.number)) and slowest_s <= dt_s < np.inf:
        raise WrongArgumentError(
            f"dt_s = {dt_s:g} is in seconds: did you mean 1/{dt_s:g}? Of a rate of {dt_s:g} Hz it is "
            f"{1 / dt_s:.6g}"
        )


def options_of(kind: type[Options], options: Options | None, settings: dict[str, Any]) -> Options | None:
    """The options, or those that single settings make. Raises ValueError for both, and as the settings."""
    if options is not None and settings:
        raise ValueError(f"give options or single settings, not both; got options and {', '.join(settings)}")
    return kind(**settings) if settings else options
