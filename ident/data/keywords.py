"""Calls that a function or a class does not take, refused in one line that names what was meant.

Python says that a keyword was unexpected, not which one is right. `clear_call` is put on functions where they
are defined, `clear_constructor` on classes: both look at a call only after it has failed, so that a call that
is right costs nothing. `refuse_rate` refuses a sampling time that is rather a rate in Hz.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from typing import Any, TypeVar

import numpy as np

from ident.data.settings import meant

F = TypeVar("F", bound=Callable[..., Any])
ClassT = TypeVar("ClassT", bound=type)

# Sampling times from here on, s, are refused as rates: no arm is sampled every 20 s, and few at fewer than
# 20 Hz. Chosen; twice as much would take a rate of 25 Hz, of a camera, for seconds.
_SLOWEST_S = 20.0


class WrongArgumentError(ValueError, TypeError):
    """A keyword or a system that has no place here; one line that says what to do."""


def clear_call(function: F) -> F:
    """Return the function as one that refuses a call it does not take in one line.

    Parameters
    ----------
    function : callable
        Without `**keywords` of its own that it does not check itself: any keyword fits these.

    Returns
    -------
    callable
        With the signature and the docstring of the function. It raises WrongArgumentError for an unknown
        keyword, a missing argument or one too many; every other error is the function's own.
    """
    return _clear(function, function.__qualname__)


def clear_constructor(kind: ClassT) -> ClassT:
    """Return the class, whose constructor refuses a call it does not take in one line (`clear_call`).

    To be put above `@dataclass`, which writes the constructor.
    """
    kind.__init__ = _clear(kind.__init__, kind.__name__)  # type: ignore[misc]
    return kind


def _clear(function: F, label: str) -> F:
    """Return the function, complaining under this label about a call that its signature does not take."""

    @wraps(function)
    def called(*arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        except TypeError:
            complaint = _complaint(function, label, arguments, named)
            if complaint is None:
                raise
        raise WrongArgumentError(complaint)

    return called  # type: ignore[return-value]


def _complaint(
    function: Callable[..., Any], label: str, arguments: tuple[Any, ...], named: Mapping[str, Any]
) -> str | None:
    """Return what is wrong with a call in one line; None where the signature takes it."""
    signature = inspect.signature(function)
    try:
        signature.bind(*arguments, **named)
    except TypeError:
        pass
    else:
        return None
    parameters = [each for each in signature.parameters.values() if each.name not in ("self", "cls")]
    known = [each.name for each in parameters if each.kind not in (each.VAR_KEYWORD, each.VAR_POSITIONAL)]
    for name in named:
        if name not in known:
            return f"{label}: unknown keyword {name} ({meant(name, known, 'keywords')})"
    # One too many or too few: an array among them is most likely a signal that belongs into a record.
    signals = any(isinstance(each, np.ndarray) for each in arguments)
    hint = "; signals are one argument: flexlink.Record(u=u, y=y, dt_s=dt_s)" if signals else ""
    return f"{label}: expected {label}({_call_of(parameters)}){hint}"


def _call_of(parameters: Iterable[inspect.Parameter]) -> str:
    """Return how a function is called: names of what may stand by itself, NAME=... of keywords."""
    parts = []
    for parameter in parameters:
        if parameter.kind is parameter.VAR_POSITIONAL:
            parts.append(f"*{parameter.name}")
        elif parameter.kind is parameter.VAR_KEYWORD:
            parts.append("...")
        elif parameter.kind is parameter.KEYWORD_ONLY:
            parts.append(f"{parameter.name}=...")
        else:
            parts.append(parameter.name)
    return ", ".join(parts)


def refuse_rate(dt_s: float) -> None:
    """Raise WrongArgumentError, a ValueError, for a sampling time in s that is rather a rate in Hz.

    An infinite one, and nan, are for the caller to refuse.
    """
    if _SLOWEST_S <= dt_s < np.inf:
        raise WrongArgumentError(
            f"dt_s = {dt_s:g} is in seconds: did you mean 1/{dt_s:g}? Of a rate of {dt_s:g} Hz it is "
            f"{1 / dt_s:.6g}"
        )
