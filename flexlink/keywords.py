"""What every function of the front door does: one thread, and a call that it does not take said in a line."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from ident.data.keywords import clear_call
from ident.data.settings import Settings

F = TypeVar("F", bound=Callable[..., Any])
Options = TypeVar("Options", bound=Settings)


def front_door(function: F) -> F:
    """Return a function as the front door offers it.

    It runs on one BLAS thread, as the commands do (matrices here are small: more threads cost time), and
    refuses a call that it does not take in one line (`ident.data.keywords.clear_call`).
    """
    clear = clear_call(function)

    @wraps(function)
    def called(*arguments: Any, **named: Any) -> Any:
        # With several threads sums round otherwise: the same call would give other last digits.
        with threadpool_limits(1):
            return clear(*arguments, **named)

    return called  # type: ignore[return-value]


def options_of(kind: type[Options], options: Options | None, settings: dict[str, Any]) -> Options | None:
    """Return the options, or those that single settings make.

    Raises ValueError where both are given, and for settings that the class of options refuses.
    """
    if options is not None and settings:
        raise ValueError(f"give options or single settings, not both; got options and {', '.join(settings)}")
    return kind(**settings) if settings else options
