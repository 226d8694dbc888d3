"""Calls that a function or a class does not take, refused in one line that names what was meant.

Python says that a keyword was unexpected, not which one is right. `clear_call` is put on functions where they
are defined, `clear_constructor` on classes: both look at a call only after it has failed, so that a call that
is right costs nothing. `refuse_rate` refuses a sampling time that is rather a rate in Hz.
"""

from __future__ import annotations

import inspect
import numbers
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

import numpy as np

from ident.data.settings import meant

F = TypeVar("F", bound=Callable[..., Any])
ClassT = TypeVar("ClassT", bound=type)

# Classes whose values stand for a number or a word of an annotation, too.
_STANDING_IN: dict[type, list[type]] = {
    float: [numbers.Real],
    int: [numbers.Integral],
    complex: [numbers.Complex],
}
# What classes are called in a complaint where their own name says less.
_NAMES: dict[type, str] = {
    numbers.Real: "a number",
    numbers.Integral: "a whole number",
    numbers.Complex: "a number",
    str: "a text",
    Iterable: "a list",
    type(None): "None",
}
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
        keyword, a missing argument or one too many, and for an argument of another type than its annotation
        says where the function fails on it; every other error is the function's own.
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
        except WrongArgumentError:
            raise
        except (TypeError, AttributeError):
            complaint = _complaint(function, label, arguments, named) or _wrong_type(
                function, label, arguments, named
            )
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
            instead = meant(name, known, "keywords") if known else "it takes no arguments"
            return f"{label}: unknown keyword {name} ({instead})"
    # One too many or too few: an array among them is most likely a signal that belongs into a record.
    signals = any(isinstance(each, np.ndarray) for each in arguments)
    hint = "; signals are one argument: flexlink.Record(u=u, y=y, dt_s=dt_s)" if signals else ""
    return f"{label}: expected {label}({_call_of(parameters)}){hint}"


def _wrong_type(
    function: Callable[..., Any], label: str, arguments: tuple[Any, ...], named: Mapping[str, Any]
) -> str | None:
    """Return which argument is of another type than its annotation says; None where none surely is.

    The call has failed, and its signature takes it: what is looked for is an argument in another's place.
    """
    signature = inspect.signature(function)
    parameters = [each for each in signature.parameters.values() if each.name not in ("self", "cls")]
    for name, value in signature.bind(*arguments, **named).arguments.items():
        parameter = signature.parameters[name]
        if parameter not in parameters or parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            continue
        expected = _classes_of(_evaluated(parameter.annotation, function))
        if expected and not isinstance(value, expected):
            wanted = " or ".join(dict.fromkeys(_NAMES.get(each, each.__name__) for each in expected))
            found = type(value).__name__
            return f"{label}: {name} is of type {found}, expected {wanted}: {label}({_call_of(parameters)})"
    return None


def _evaluated(annotation: Any, function: Callable[..., Any]) -> Any:
    """Return an annotation as a type; Any where it names what its module has for a type checker only."""
    if not isinstance(annotation, str):
        return annotation
    try:
        # Written by ourselves in the source of the function.
        return eval(annotation, getattr(inspect.unwrap(function), "__globals__", {}))
    except (NameError, TypeError, AttributeError):
        return Any


def _classes_of(annotation: Any) -> tuple[type, ...]:
    """Return the classes of which a value of this annotation is an instance of one; () where any may do."""
    members = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    classes: list[type] = []
    for member in members:
        kind = type(None) if member is None else get_origin(member) or member
        if not isinstance(kind, type) or kind in (Any, object) or getattr(kind, "_is_protocol", False):
            return ()
        if kind in _STANDING_IN:
            classes += _STANDING_IN[kind]
        elif kind.__module__ in ("collections.abc", "numpy") or kind in (list, tuple, dict):
            # What is read one by one may be an array, a list or a table's column.
            classes.append(Iterable)
        else:
            classes.append(kind)
    return tuple(classes)


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
